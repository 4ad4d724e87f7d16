"""The graphics devices that EGL knows, and which of them to draw with: a graphics card before a processor.

EGL_EXT_device_query says of each device whether it is software (EGL_MESA_device_software).
"""

import contextlib
import ctypes
import os
from collections.abc import Callable, Sequence

ENVIRONMENT = "GLCONTEXT_DEVICE_INDEX"
"""Environment variable with the number of the device to draw with, as moderngl's glcontext has it."""
_MOST = 32
_EXTENSIONS = 0x3055  # of egl.h


def known() -> list[bool]:
    """Return of each device, in EGL's order, whether it is software; none where this EGL cannot say."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        return _asked(ctypes.CDLL("libEGL.so.1"))
    return []


def _asked(egl: ctypes.CDLL) -> list[bool]:
    egl.eglGetProcAddress.restype = ctypes.c_void_p

    def function(name: bytes, result: type | None, *arguments: type) -> Callable:
        return ctypes.CFUNCTYPE(result, *arguments)(egl.eglGetProcAddress(name))

    pointer = ctypes.c_void_p
    query = function(b"eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, pointer, pointer)
    text = function(b"eglQueryDeviceStringEXT", ctypes.c_char_p, pointer, ctypes.c_int)
    found, count = (pointer * _MOST)(), ctypes.c_int()
    if not query(_MOST, found, ctypes.byref(count)):
        return []
    return [b"EGL_MESA_device_software" in (text(device, _EXTENSIONS) or b"") for device in found[: count.value]]


def preferred(software: Sequence[bool]) -> list[int | None]:
    """Return the numbers of the devices to try, in this order; None leaves the choice to EGL.

    Args:
        software: as `known` has it.

    Raises:
        ValueError: the environment variable is no number, or that of no device.
    """
    if stated := os.environ.get(ENVIRONMENT):
        if not stated.isdigit() or (software and int(stated) >= len(software)):
            raise ValueError(f"{ENVIRONMENT}={stated}: no such device; EGL has {len(software)} here, numbered from 0")
        return [int(stated)]
    return [*sorted(range(len(software)), key=software.__getitem__)] or [None]
