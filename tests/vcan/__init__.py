"""A real vcan0 for the tests: this machine's own, or that of a kernel booted for them (user-mode Linux, QEMU)."""

__all__: list[str] = []
