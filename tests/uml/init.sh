#!/bin/sh
# First process of user-mode Linux. VANELOOP_JOB (from the kernel's command line) is a folder of the host: its file `command` is run with
# vcan0 up, `output` takes what it prints, `exit` its exit code; `failed` says why it could not be run.
PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PATH
stop() { [ -z "$1" ] || echo "$1" >"$VANELOOP_JOB/failed"; sync; halt -f 2>/dev/null; echo o >/proc/sysrq-trigger; sleep 10; }

mount -t proc proc /proc && mount -t sysfs sysfs /sys && mount -t tmpfs tmpfs /run || stop "proc, sysfs and /run could not be mounted"
mkdir -p /dev/shm /dev/pts && mount -t tmpfs tmpfs /dev/shm && mount -t devpts devpts /dev/pts
modules=/usr/lib/uml/modules/$(uname -r)/kernel
for name in net/can/can net/can/can-raw net/can/can-bcm drivers/net/can/dev/can-dev drivers/net/can/vcan; do
  insmod "$modules/$name.ko" || stop "the module $modules/$name.ko could not be loaded"
done
ip link set lo up && ip link add dev vcan0 type vcan && ip link set vcan0 up || stop "vcan0 could not be made"

sh "$VANELOOP_JOB/command" </dev/null >"$VANELOOP_JOB/output" 2>&1
echo $? >"$VANELOOP_JOB/exit"
stop
