"""Input files: read whole, of a limited size, and never waited for."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

_STEPS = {
    errno.EISDIR: "Give a file",
    errno.ENOENT: "Check the path",
    errno.ENAMETOOLONG: "Check the path",
    errno.EACCES: "Check its permissions",
    errno.EINVAL: "Give a file",
    errno.EFBIG: "",
}
"""What to do about a file that cannot be read; a file that is too large says so itself."""

MOST_BYTES = 4 * 1024**3
"""Of a file that is read whole: no cloud is larger, but a recording given by mistake may be."""


def read_input(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Reads a file whole. A pipe without a writer would block for ever, and a device has no end.

    Raises:
        OSError: it is missing, a folder, a pipe or a device, too large or unreadable; `strerror`
            says so in a few words.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "is a pipe or a device, expected a file", str(path))
    if status.st_size > most_bytes:
        size, most = status.st_size / 1e6, most_bytes / 1e6
        message = f"has {size:.0f} MB, expected at most {most:.0f} MB. Is it the right file?"
        raise OSError(errno.EFBIG, message, os.fspath(path))
    return path.read_bytes()


def unreadable(error: OSError) -> str:
    """Why a file cannot be read, and what to do: `cannot be read: Is a directory. Give a file`."""
    step = _STEPS.get(error.errno or 0, "Check the path, its permissions and the disk")
    why = f"cannot be read: {error.strerror or error}"
    return f"{why}. {step}" if step else why
