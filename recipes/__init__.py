"""Entry points: the only place with an argument parser, a logger, a device choice and files on disk."""

import sys
from types import TracebackType


def tell_ctrl_c_in_a_line(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Stand for ``sys.excepthook`` until a command has imported what it needs; see `recipes.interrupt`."""
    if issubclass(kind, KeyboardInterrupt):
        print("\nstopped by Ctrl-C", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if sys.argv[:1] == ["-m"]:  # python -m recipes.NAME, which has not been imported yet: that takes seconds
    sys.excepthook = tell_ctrl_c_in_a_line
