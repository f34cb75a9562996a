#!/bin/busybox sh
# First process of QEMU's kernel: makes the host's files its root, and hands over to init.sh. The folder of the job is not cached, so
# that what is written there is on the host at once.
b=/bin/busybox
$b mount -t proc proc /proc
for module in $($b cat /modules/order); do
  $b insmod "/modules/$module" || echo "the module $module could not be loaded"
done
options=trans=virtio,version=9p2000.L,msize=262144
if $b mount -t 9p -o $options,cache=loose host /host &&
  $b mount -t 9p -o $options,cache=none job "/host$VANELOOP_JOB" && $b mount -t devtmpfs dev /host/dev; then
  $b umount /proc
  exec $b switch_root /host "$VANELOOP_JOB/init.sh"
fi
echo "the host's files could not be mounted"
$b sync
echo o >/proc/sysrq-trigger
$b sleep 10
