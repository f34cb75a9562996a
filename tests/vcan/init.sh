#!/bin/sh
# First process of a booted kernel that sees the host's files. VANELOOP_JOB (from the kernel's command line) is a folder of the host:
# `check` must succeed with vcan0 up, then `command` is run; `output` takes what it prints, `exit` its exit code; `failed` says why it
# could not be run. The CAN modules of this kernel are in VANELOOP_MODULES.
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PATH
stop() { [ -z "$1" ] || echo "$1" >"$VANELOOP_JOB/failed"; sync; echo o >/proc/sysrq-trigger; sleep 10; halt -f; }

mount -t proc proc /proc && mount -t sysfs sysfs /sys && mount -t tmpfs tmpfs /run || stop "proc, sysfs and /run could not be mounted"
mkdir -p /dev/shm /dev/pts /run/tmp && mount -t tmpfs tmpfs /dev/shm && mount -t devpts devpts /dev/pts
modules=$VANELOOP_MODULES/$(uname -r)/kernel
for name in net/can/can net/can/can-raw net/can/can-bcm drivers/net/can/dev/can-dev drivers/net/can/vcan; do
  insmod "$modules/$name.ko" || stop "the module $modules/$name.ko could not be loaded"
done
ip link set lo up && ip link add dev vcan0 type vcan && ip link set vcan0 up || stop "vcan0 could not be made"
sh "$VANELOOP_JOB/check" </dev/null >"$VANELOOP_JOB/checked" 2>&1 || stop "Python does not run there: $(tail -n 1 "$VANELOOP_JOB/checked")"

sh "$VANELOOP_JOB/command" </dev/null >"$VANELOOP_JOB/output" 2>&1
echo $? >"$VANELOOP_JOB/exit.part"
mv "$VANELOOP_JOB/exit.part" "$VANELOOP_JOB/exit"
stop
