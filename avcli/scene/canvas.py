"""A headless graphics context that sees through one camera: what all passes of the renderer draw with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from avcli import pose
from avcli.formats.experiment import Camera
from avcli.lens import shader as lens_shader
from avcli.scene import devices, shaders

if TYPE_CHECKING:
    import moderngl

_RAYS_UNIT = 7  # where the shaders find the pixels' rays
_NEAR_FAR_M = 64.0  # distances up to this are told apart alike in every room that it holds
COARSE = 4  # px, the grid on which the room's light is computed


class NoGraphics(RuntimeError):
    """There is no way to draw on this machine; the message says what to install."""


def open_context() -> moderngl.Context:
    """Open a headless OpenGL context, on a graphics card where there is one; `devices` says how to choose another.

    Raises:
        NoGraphics: there is no EGL or no driver, or the device that was asked for cannot draw.
    """
    import moderngl

    fault: Exception | None = None
    try:
        for number in devices.preferred(devices.known()):
            options: dict[str, Any] = {"backend": "egl", "require": 330}
            options |= {} if number is None else {"device_index": number}
            try:
                return moderngl.create_context(standalone=True, **options)
            except Exception as error:
                fault = fault or error
    except ValueError as error:
        raise NoGraphics(str(error)) from None
    raise NoGraphics(
        f"cannot open headless OpenGL ({fault}); on Debian: apt-get install libegl1 libgl1 libegl-mesa0 libgl1-mesa-dri"
    )


class Canvas:
    """A context with a camera's lens in it.

    Args:
        camera: whose pixels are drawn.
        room: (3,) m, the room's size.
        samples: colour samples per pixel at outlines.
        context: to share; None opens one.

    Attributes:
        size: (width, height) px.
        largest: px, the longest side of a picture that this OpenGL draws.
        drawn_by: names of the OpenGL and its version.
        T_camera_room: (4, 4) maps room coordinates to the camera's, m.
        surroundings: uniforms that say where the camera is in the room, and where the lamps are.
        wait: returns when all has been drawn.

    Raises:
        NoGraphics: there is no OpenGL on this machine.
        ValueError: the image is larger than this OpenGL draws.
    """

    def __init__(self, camera: Camera, room: np.ndarray, samples: int, context: moderngl.Context | None = None) -> None:
        self.camera = camera
        self.size = camera.width_px, camera.height_px
        self.ctx, self.wait = context or open_context(), _finish()
        self.ctx.enable(self.ctx.DEPTH_TEST)
        self.largest: int = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        self.drawn_by = " ".join(self.ctx.info[f"GL_{part}"] for part in ("VENDOR", "RENDERER", "VERSION"))
        if max(self.size) > self.largest:
            raise ValueError(
                f"an image of {self.size[0]} x {self.size[1]} px: this OpenGL draws at most {self.largest} px per side"
            )
        self.T_camera_room = pose.inverse(camera.T_room_camera)
        self._lens = lens_shader.uniforms(camera.lens, *self.size)
        self._far = max(_NEAR_FAR_M, 1.01 * farthest(camera, room))
        T = camera.T_room_camera
        x, y, z = np.asarray(room, float)
        self.surroundings: dict[str, Any] = {
            "to_room": tuple(T[:3, :3].T.ravel()), "eye": tuple(T[:3, 3]), "room": (x, y, z),
            "lamps": [(0.28 * x, 0.5 * y, z), (0.72 * x, 0.5 * y, z)], "coarse": COARSE, "samples": samples,
        }  # fmt: skip
        self._rays = self.ctx.texture(self.size, 4 if "tangent" in self._lens else 2, dtype="f4")
        self.fill(
            self.program(shaders.FLAT_VERTEX, shaders.RAYS, circle=camera.circle or (0, 0, 0)),
            self.ctx.framebuffer([self._rays]),
        )
        self.use_rays()

    def use_rays(self) -> None:
        """Make the rays of this camera's pixels those that the shaders look up."""
        self._rays.use(_RAYS_UNIT)

    def program(self, vertex: str, fragment: str, **uniforms: Any) -> moderngl.Program:
        """Compile a program and set those of its uniforms that it has; the lens's are always set."""
        fragment = lens_shader.specialised(fragment, self._lens)
        program = self.ctx.program(vertex_shader=vertex, fragment_shader=fragment)
        put(program, **self._lens, **uniforms, rays=_RAYS_UNIT, far=self._far)
        return program

    def fill(
        self,
        program: moderngl.Program,
        target: moderngl.Framebuffer,
        textures: Mapping[str, moderngl.Texture | moderngl.Texture3D] | None = None,
        *,
        depth: bool = False,
    ) -> None:
        """Run a program over all of a target's pixels, or with `depth` over those that its depth lets pass.

        Args:
            program: to run.
            target: to draw into.
            textures: that the program looks up, by the names of its samplers.
            depth: whether pixels are tested against the target's depth.
        """
        textures = textures or {}
        put(program, size=target.size, **{name: unit for unit, name in enumerate(textures)})
        for unit, texture in enumerate(textures.values()):
            texture.use(unit)
        target.use()
        (self.ctx.enable if depth else self.ctx.disable)(self.ctx.DEPTH_TEST)
        self.quads(program, np.array([[0, 0, *target.size]]), "4f/i", ("rectangle",))

    def quads(self, program: moderngl.Program, rows: np.ndarray, layout: str, names: Sequence[str]) -> None:
        """Draw a quadrangle for each row (n, m) of attributes, in the layout and of the names that the program has."""
        if not len(rows):
            return
        buffer = self.ctx.buffer(np.ascontiguousarray(rows, "f4").tobytes())
        array = self.ctx.vertex_array(program, [(buffer, layout, *names)])
        array.render(self.ctx.TRIANGLE_STRIP, 4, instances=len(rows))
        array.release()
        buffer.release()

    def table(self, rows: np.ndarray) -> moderngl.Texture:
        """A texture of floats that shaders look up with `table_place`, of rows (n, m, 4) with n, m > 0.

        Row k stands in line k modulo TABLE_LINES of it: it may have more rows than a texture has lines.
        """
        count, width = rows.shape[:2]
        blocks = -(-count // shaders.TABLE_LINES)
        lines = min(count, shaders.TABLE_LINES)
        padded = np.zeros((blocks * lines, width, 4), "f4")
        padded[:count] = rows
        lined = np.ascontiguousarray(padded.reshape(blocks, lines, width, 4).swapaxes(0, 1))
        texture = self.ctx.texture((blocks * width, lines), 4, lined.tobytes(), dtype="f4")
        texture.filter = (self.ctx.NEAREST, self.ctx.NEAREST)
        return texture


def put(program: moderngl.Program, **values: Any) -> None:
    """Set those uniforms that a program has."""
    for name, value in values.items():
        if name in program:
            program[name] = value


def _finish() -> Callable[[], None]:
    """glFinish, called so that other threads run Python meanwhile; moderngl's calls keep them waiting."""
    import ctypes

    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    return ctypes.CFUNCTYPE(None)(egl.eglGetProcAddress(b"glFinish"))


def farthest(camera: Camera, room: np.ndarray) -> float:
    """Distance from a camera to the farthest corner of its room (3,) m: nothing that is drawn is farther away."""
    eye = camera.T_room_camera[:3, 3]
    return float(np.linalg.norm(np.maximum(eye, np.asarray(room, float) - eye)))


# --- rectangles and colours -------------------------------------------------------------------------------------------


def bounds(pixels: np.ndarray, margin: float) -> np.ndarray:
    """Rectangles (..., 4) in pixel edges around pixels (..., m, 2), px; NaN where a pixel is."""
    low, high = pixels.min(-2) + 0.5 - margin, pixels.max(-2) + 0.5 + margin
    return np.concatenate([low, high], -1)


def clip(rectangles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Rectangles (..., 4), px, widened to whole pixels and cut to the picture; empty where they were NaN."""
    kept = np.nan_to_num(rectangles, nan=0.0)
    return np.clip(np.concatenate([np.floor(kept[..., :2]), np.ceil(kept[..., 2:])], -1), 0, [*size, *size])


def linear(srgb: np.ndarray) -> np.ndarray:
    """Linear light of sRGB fractions, of any shape (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
