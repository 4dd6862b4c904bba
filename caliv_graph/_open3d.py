"""The only import of open3d: late, because it takes a second, and with its shared libraries.

open3d 0.20 is linked against libusb-1.0.so.0, which slim images lack. PyPI's `libusb-package`
contains this library under another file name but with the same SONAME. Loading it first satisfies
the linker without apt. libGL, libEGL and libX11 have no such package.
"""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
from typing import Any

from caliv_graph.errors import CalivError

LIBUSB = "libusb-1.0.so.0"
DEBIAN_PACKAGES = {
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
"""Shared libraries that open3d needs from the system, and the Debian package of each."""


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True


def _preload_libusb() -> bool:
    """Loads libusb: the system's, or else that of `libusb-package`."""
    if _loads(LIBUSB):
        return True
    try:
        package = importlib.import_module("libusb_package")
    except ImportError:
        return False
    path = package.get_library_path()
    return path is not None and _loads(str(path))


def _reason(error: Exception, have_libusb: bool) -> str:
    missing = [library for library in DEBIAN_PACKAGES if not _loads(library)]
    if missing:
        packages = " ".join(DEBIAN_PACKAGES[library] for library in missing)
        return f"{', '.join(missing)} missing: install them with 'apt-get install {packages}'"
    if not have_libusb:
        return (
            f"{LIBUSB} missing: install it with 'pip install libusb-package' "
            "or 'apt-get install libusb-1.0-0'"
        )
    return str(error).strip().splitlines()[0] if str(error).strip() else repr(error)


@functools.cache
def import_open3d() -> Any:
    """Imports open3d, about 1 s the first time.

    Returns:
        The module `open3d`.

    Raises:
        CalivError: it is not installed, or a shared library that it needs is missing; names the
            packages that contain it.
    """
    have_libusb = _preload_libusb() if sys.platform == "linux" else True
    try:
        return importlib.import_module("open3d")
    except ModuleNotFoundError as e:
        raise CalivError(
            f"open3d: module '{e.name}' is not installed: 'pip install open3d'"
        ) from None
    except (ImportError, OSError) as e:
        raise CalivError(f"open3d cannot be loaded: {_reason(e, have_libusb)}") from None
