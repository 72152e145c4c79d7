"""What a command's exit code says. `InputError` (2) and `DeviceError` (3) carry theirs."""

EXIT_INTERNAL, EXIT_INPUT, EXIT_CHECK, EXIT_INTERRUPTED = 1, 2, 4, 130


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command as Ctrl-C does."""
