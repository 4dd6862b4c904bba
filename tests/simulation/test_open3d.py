"""Importing open3d: a missing library is named together with the package that contains it."""

import ctypes
import importlib
import sys
from types import ModuleType

import pytest

from caliv_graph import _open3d
from caliv_graph._open3d import import_open3d
from caliv_graph.errors import CalivError


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """`import_open3d` without its cache, and open3d itself refusing to load."""
    monkeypatch.setattr(_open3d, "import_open3d", import_open3d.__wrapped__)
    monkeypatch.setattr(sys, "platform", "linux")
    return monkeypatch


def without_libraries(*parts: str) -> object:
    """`ctypes.CDLL` on a machine that lacks all libraries with one of these parts in their name."""

    def load(name: str, mode: int = 0) -> None:
        if any(part in name for part in parts):
            raise OSError(f"{name}: cannot open shared object file")

    return load


def refuse(error: Exception, *names: str) -> object:
    real = importlib.import_module

    def import_module(name: str) -> ModuleType:
        if name in names:
            raise error
        return real(name)

    return import_module


def test_open3d_comes_with_its_ray_caster() -> None:
    assert hasattr(import_open3d().t.geometry, "RaycastingScene")
    assert import_open3d() is import_open3d()


def test_missing_system_libraries_are_named_with_their_packages(
    fresh: pytest.MonkeyPatch,
) -> None:
    error = ImportError("libGL.so.1: cannot open shared object file")
    fresh.setattr(importlib, "import_module", refuse(error, "open3d"))
    fresh.setattr(ctypes, "CDLL", without_libraries("libGL", "libEGL", "libX11", "libusb"))
    with pytest.raises(CalivError) as caught:
        _open3d.import_open3d()
    assert str(caught.value) == (
        "open3d cannot be loaded: libGL.so.1, libEGL.so.1, libX11.so.6 missing: "
        "install them with 'apt-get install libgl1 libegl1 libx11-6'"
    )


def test_missing_libusb_is_named_with_its_package(fresh: pytest.MonkeyPatch) -> None:
    error = ImportError("libusb-1.0.so.0: cannot open shared object file")
    fresh.setattr(importlib, "import_module", refuse(error, "open3d", "libusb_package"))
    fresh.setattr(ctypes, "CDLL", without_libraries("usb"))
    with pytest.raises(CalivError, match="'pip install libusb-package'"):
        _open3d.import_open3d()


def test_missing_open3d_is_named(fresh: pytest.MonkeyPatch) -> None:
    error = ModuleNotFoundError("No module named 'open3d'", name="open3d")
    fresh.setattr(importlib, "import_module", refuse(error, "open3d"))
    with pytest.raises(CalivError, match="'open3d' is not installed: 'pip install open3d'"):
        _open3d.import_open3d()


def test_any_other_failure_is_one_line(fresh: pytest.MonkeyPatch) -> None:
    error = ImportError("undefined symbol: abc\nmore")
    fresh.setattr(importlib, "import_module", refuse(error, "open3d"))
    fresh.setattr(ctypes, "CDLL", without_libraries())
    with pytest.raises(CalivError) as caught:
        _open3d.import_open3d()
    assert str(caught.value) == "open3d cannot be loaded: undefined symbol: abc"
