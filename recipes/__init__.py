"""Entry points: the only place with an argument parser, a logger, a device choice and files on disk."""

import os
import signal
import sys
from types import FrameType


def end_at_ctrl_c(signum: int, frame: FrameType | None) -> None:
    """End the process, with a line, until a command has imported what it needs; see `recipes.interrupt`.

    Nothing has begun that would have to be put away, and an exception could be lost: libraries catch what fails while
    they are imported, and Python passes over what is raised in a callback.
    """
    os.write(2, b"\nstopped by Ctrl-C\n")
    os._exit(128 + signum)


# python -m recipes.NAME, which has not been imported yet: that takes seconds. Not where Ctrl-C is ignored.
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, end_at_ctrl_c)
