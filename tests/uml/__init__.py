"""User-mode Linux: a kernel with SocketCAN, as an ordinary program, for tests on machines whose own kernel has no CAN."""

__all__: list[str] = []
