"""The command ``conefield``: ``python -m conefield``, or the script that the package installs."""

import signal
import sys

from . import _native


def main() -> None:
    # The command handles Ctrl-C. Python's own handler would run after it, too.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Python's buffered output must precede the command's output.
    sys.stdout.flush()
    sys.exit(_native.command(["conefield", *sys.argv[1:]], [sys.executable, "-m", "conefield"]))


if __name__ == "__main__":
    main()
