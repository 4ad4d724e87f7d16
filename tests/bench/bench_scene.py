"""Run time against depth error of the renderer, beside a cube map with warp and embree, all in one run.

    python tests/bench/bench_scene.py --out bench-out [--quick]

examples/benchmarks holds the table and the plot of one run.

Times are the median over a scene's frames (of peers the least of several calls), in CPU milliseconds (all threads
together: on n free cores a frame takes about an n-th) and in wall milliseconds, which a busy machine makes larger.
Errors are of radial depth against embree on the same bodies as fine triangles (96 meridians a cone, rays in float64),
away from edges by one pixel; "wrong" counts pixels more than 20 mm off. The cube map is what tools on top of game
engines do: the same triangles (32 meridians) rasterised into five pinhole faces, then looked up through the lens.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import moderngl
import numpy as np
from figures import Row, figure, hand_over

from avcli import pose
from avcli.formats import png
from avcli.scene import mesh, people, render, scenario, worlds

T = TypeVar("T")
REAL, VIRTUAL = scenario.CAMERAS["real"], scenario.CAMERAS["thesis"]
FACE_VERTEX = """#version 330
in vec3 corner;
uniform mat4 face;
out vec3 place;
void main() { place = corner; gl_Position = face * vec4(corner, 1.0); }
"""
FACE_FRAGMENT = """#version 330
in vec3 place;
out float far;
void main() { far = length(place); }
"""
WARP_VERTEX = "#version 330\nin vec2 at;\nvoid main() { gl_Position = vec4(at, 0.0, 1.0); }\n"
WARP_FRAGMENT = """#version 330
uniform sampler2D ahead, right, left, below, above, rays;
out float far;
void main() {
    vec3 d = texelFetch(rays, ivec2(gl_FragCoord.xy), 0).xyz, a = abs(d);
    far = 0.0;
    if (d == vec3(0.0)) return;
    int face = a.z >= max(a.x, a.y) ? 0 : a.x >= a.y ? (d.x > 0.0 ? 1 : 2) : (d.y > 0.0 ? 3 : 4);
    vec2 uv = face == 0 ? d.xy / a.z : a.x >= a.y ? d.yz / a.x : d.xz / a.y;
    uv = uv * 0.5 + 0.5;
    far = face == 0 ? texture(ahead, uv).r : face == 1 ? texture(right, uv).r : face == 2 ? texture(left, uv).r
        : face == 3 ? texture(below, uv).r : texture(above, uv).r;
}
"""


def least(work: Callable[[], T], repeat: int) -> tuple[float, float, T]:
    """CPU and wall milliseconds of the fastest of several calls, and the last result."""
    cpu, wall = np.inf, np.inf
    for _ in range(repeat):
        c, w = time.process_time(), time.perf_counter()
        result = work()
        cpu, wall = min(cpu, time.process_time() - c), min(wall, time.perf_counter() - w)
    return 1e3 * cpu, 1e3 * wall, result


def scaled(camera: Mapping[str, Any], width: int) -> dict[str, Any]:
    """The same lens on an image of another width."""
    factor = width / camera["image_width_px"]
    keys = ("fx_px", "fy_px", "cx_px", "cy_px")
    size = {"image_width_px": width, "image_height_px": round(camera["image_height_px"] * factor)}
    return {**camera, **size, **{key: camera[key] * factor for key in keys}}


def scene_of(camera: Mapping[str, Any], count: int) -> scenario.Scenario:
    """S3 for three people, else a random crowd, seen by the camera."""
    if count == 3:
        raw = json.loads((resources.files("avcli.scene") / "scenarios" / "s3.json").read_bytes())
    else:
        wishes = worlds.Wishes(count, "corridor", (4.66, 4.66, 3.0))
        raw = worlds.random_world(wishes, 4.0, np.random.default_rng(count), scenario.CAMERAS)
    return scenario.parse(scenario.with_camera(raw, camera), f"{count} people")


class Reference:
    """Depth by embree, and which pixels are away from edges."""

    def __init__(self, scene: scenario.Scenario, bodies: people.Bodies, index: int) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        camera = scene.config.camera
        self.shape = camera.height_px, camera.width_px
        u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
        rays = camera.lens.unproject(np.stack([u.ravel(), v.ravel()], -1)) @ camera.T_room_camera[:3, :3].T
        self.seen = np.isfinite(rays[:, 0])
        self.eye = camera.T_room_camera[:3, 3]
        self.rays = rays[self.seen]
        self.fine, self.plain = (self._caster(scene, bodies, index, n, trimesh, RayMeshIntersector) for n in (96, 32))
        self.depth = self.cast(self.fine)
        image = self.depth.reshape(self.shape)
        edge = np.zeros(self.shape, bool)
        for axis in (0, 1):
            jump = np.abs(np.diff(image, axis=axis)) > 0.03
            pad = [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)]
            edge |= np.pad(jump, pad) | np.pad(jump, [p[::-1] for p in pad])
        self.inner = ~edge.ravel() & self.seen

    def _caster(
        self, scene: scenario.Scenario, bodies: people.Bodies, index: int, segments: int, trimesh: Any, kind: Any
    ) -> Any:
        parts = [
            mesh.room_triangles(scene.config.room.dimensions),
            mesh.solids_triangles(scene.solids, 4 * segments)[0],
            mesh.bodies_triangles(bodies, index, segments)[0],
        ]
        self.triangles = np.concatenate(parts)
        return kind(trimesh.Trimesh(**trimesh.triangles.to_kwargs(self.triangles), process=False))

    def cast(self, caster: Any) -> np.ndarray:
        """Depth of each pixel, m, 0 for none."""
        eye = np.tile(self.eye, (len(self.rays), 1))
        _, ray, at = caster.intersects_id(eye, self.rays, multiple_hits=False, return_locations=True)
        hit = np.zeros(len(self.rays))
        hit[ray] = np.linalg.norm(at - self.eye, axis=1)
        depth = np.zeros(self.seen.size)
        depth[self.seen] = hit
        return depth

    def error(self, depth: np.ndarray) -> dict[str, float]:
        """Median and 99.9th percentile of the error, mm, and the share of wrong pixels, %."""
        wrong = np.abs(depth.ravel() - self.depth)[self.inner]
        return {
            "median_mm": 1e3 * float(np.median(wrong)),
            "p99.9_mm": 1e3 * float(np.quantile(wrong, 0.999)),
            "wrong_percent": 100 * float((wrong > 0.02).mean()),
        }


class CubeMap:
    """Five pinhole faces and a look-up, on the same OpenGL."""

    def __init__(self, reference: Reference, scene: scenario.Scenario, size: int, ctx: moderngl.Context) -> None:
        self.ctx, self.size = ctx, size
        camera = scene.config.camera
        corners = pose.apply(pose.inverse(camera.T_room_camera), reference.triangles).astype("f4")
        self.faces = [ctx.texture((size, size), 1, dtype="f4") for _ in range(5)]
        for face in self.faces:  # the nearest sample: distances must not be mixed across outlines
            face.filter = (ctx.NEAREST, ctx.NEAREST)
        depth = ctx.depth_renderbuffer((size, size))
        self.targets = [ctx.framebuffer([face], depth) for face in self.faces]
        program = ctx.program(vertex_shader=FACE_VERTEX, fragment_shader=FACE_FRAGMENT)
        self.face: Any = program["face"]
        self.count = corners.size // 3
        self.array = ctx.vertex_array(program, [(ctx.buffer(corners.tobytes()), "3f", "corner")])
        rays = np.zeros((reference.seen.size, 4), "f4")
        rays[reference.seen, :3] = reference.rays @ camera.T_room_camera[:3, :3]
        height, width = reference.shape
        self.rays = ctx.texture((width, height), 4, rays.tobytes(), dtype="f4")
        self.out = ctx.framebuffer([ctx.texture((width, height), 1, dtype="f4")])
        warp = ctx.program(vertex_shader=WARP_VERTEX, fragment_shader=WARP_FRAGMENT)
        for unit, name in enumerate(("ahead", "right", "left", "below", "above", "rays")):
            warp[name] = unit
        quad = ctx.buffer(np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], "f4").tobytes())
        self.warp = ctx.vertex_array(warp, [(quad, "2f", "at")])
        # Rows: what becomes the face's x, y and depth.
        axes = [((0, 1, 2), 1), ((1, 2, 0), 1), ((1, 2, 0), -1), ((0, 2, 1), 1), ((0, 2, 1), -1)]
        near, far = 0.05, 20.0
        self.matrices = []
        for (x, y, z), sign in axes:
            M = np.zeros((4, 4))
            M[0, x], M[1, y] = 1.0, 1.0
            M[2, z], M[2, 3] = sign * (far + near) / (far - near), -2 * far * near / (far - near)
            M[3, z] = sign
            self.matrices.append(M.T.astype("f4").tobytes())

    def draw(self) -> np.ndarray:
        """Depth, (height, width) float32 m."""
        ctx = self.ctx
        ctx.enable(ctx.DEPTH_TEST)
        for target, matrix in zip(self.targets, self.matrices, strict=True):
            self.face.write(matrix)
            target.use()
            target.clear(depth=1.0)
            self.array.render(moderngl.TRIANGLES, self.count)
        self.out.use()
        ctx.disable(ctx.DEPTH_TEST)
        for unit, texture in enumerate((*self.faces, self.rays)):
            texture.use(unit)
        self.warp.render(moderngl.TRIANGLE_STRIP, 4)
        return np.frombuffer(self.out.read(components=1, dtype="f4"), np.float32)


def depth_m(renderer: render.Renderer) -> np.ndarray:
    """Radial depth of the frame that was drawn last, unrounded: (height, width) float32 m, 0 none."""
    by_people, by_room = (
        np.frombuffer(seen.read(), np.float32).reshape(seen.height, seen.width, 2)[..., 0]
        for seen in (renderer.people_seen, renderer.room_seen)
    )
    return np.where(by_people > 0, by_people, by_room)


def ours(
    scene: scenario.Scenario,
    bodies: people.Bodies,
    index: int,
    samples: int,
    ctx: moderngl.Context,
    reference: Reference | None = None,
) -> tuple[dict[str, float], render.Frame]:
    """Our renderer: the median over the scene's frames, and the frame of one index."""
    c = time.process_time()
    renderer = render.Renderer(
        scene.config.camera, scene.config.room.dimensions, scene.solids, samples=samples, context=ctx
    )
    ctx.finish()
    start = 1e3 * (time.process_time() - c)
    posing = least(lambda: renderer.prepare(people.pose(scene.people, bodies.times)), 2)[0] / len(bodies.times)
    drawn = renderer.prepare(bodies)
    renderer.draw(drawn, 0)
    spent = np.array([least(partial(renderer.draw, drawn, k), 1)[:2] for k in range(1, len(bodies.times))])
    cpu, wall = np.median(spent, axis=0).tolist()
    frame = renderer.draw(drawn, min(index, len(bodies.times) - 1))
    row = {"cpu_ms": cpu, "wall_ms": wall, "pose_cpu_ms": posing, "start_cpu_ms": start}
    return row | (reference.error(depth_m(renderer)) if reference else {}), frame


def main() -> None:
    """Measure, print, write scene.json, the table scene.md and, with matplotlib, the plot scene.svg."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--quick", action="store_true", help="three people at 1920 px only")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    ctx = render.open_context()
    rows: list[dict[str, Any]] = []
    index = 20
    times = np.arange(41) / 10

    def add(method: str, **values: Any) -> None:
        rows.append({"method": method, **values})
        shown = "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items())
        print(shown, flush=True)

    print(f"OpenGL: {ctx.info['GL_RENDERER']}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}")
    cases = [("kb8", REAL, 1920, 3)]
    if not options.quick:
        cases += [("division", VIRTUAL, 1920, 3), ("kb8", REAL, 960, 3), ("kb8", REAL, 3840, 3)]
        cases += [("kb8", REAL, 1920, n) for n in (1, 10, 30, 100)]
    for lens, camera, width, count in cases:
        scene = scene_of(scaled(camera, width), count)
        bodies = people.pose(scene.people, times if count <= 3 else times[::8])
        compared = width == 1920 and count == 3
        reference = Reference(scene, bodies, index) if compared else None
        labels = {"lens": lens, "width": width, "people": count}
        for samples in (1, 4, 8) if compared else (1, 4):
            row, frame = ours(scene, bodies, index, samples, ctx, reference)
            add(f"rounded cones, {samples} samples", **labels, **row)
        if reference:
            for size in (1024, 1724):
                cube = CubeMap(reference, scene, size, ctx)
                cpu, wall, depth = least(cube.draw, 5)
                add(f"cube map of {size}^2", **labels, cpu_ms=cpu, wall_ms=wall, **reference.error(depth))
            cpu, wall, depth = least(partial(reference.cast, reference.plain), 1)
            add("embree, 32 meridians", **labels, cpu_ms=cpu, wall_ms=wall, **reference.error(depth))
        if width == 1920 and count == 3 and lens == "kb8":
            for name, work in (
                ("png rgb", lambda f=frame: png.encode_png(f.rgb)),
                ("png depth", lambda f=frame: png.encode_png(f.depth)),
                ("raw rgb + depth: a copy of the memory", lambda f=frame: f.rgb.tobytes() + f.depth.tobytes()),
            ):
                cpu, wall, data = least(work, 7)
                add(f"encode {name}", **labels, cpu_ms=cpu, wall_ms=wall, megabytes=len(data) / 1e6)
    (options.out / "scene.json").write_text(json.dumps(rows, indent=1) + "\n")
    (options.out / "scene.md").write_text(table(rows, ctx.info["GL_RENDERER"]))
    plot(rows, options.out / "scene.svg")
    hand_over(options.out, "scene", map(as_figure, rows))


def as_figure(row: dict[str, Any]) -> Row:
    case = f"{row['width']} px, {row['lens']}, {row['people']} people"
    method = row["method"] if row["method"].startswith(("cube", "embree")) else f"avcli, {row['method']}"
    return figure("scene", case, method, row["cpu_ms"] / 1e3, "frame", row.get("p99.9_mm"), "mm, 99.9 %")


def table(rows: list[dict[str, Any]], renderer: str) -> str:
    """All rows as Markdown, with what they were measured on."""
    heads = {
        "method": "method", "lens": "lens", "width": "width, px", "people": "people", "cpu_ms": "CPU ms a frame",
        "wall_ms": "wall ms", "pose_cpu_ms": "CPU ms to pose", "start_cpu_ms": "CPU ms to start",
        "median_mm": "median error, mm", "p99.9_mm": "99.9 % error, mm", "wrong_percent": "wrong pixels, %",
        "megabytes": "MB",
    }  # fmt: skip
    lines = [
        "# Run time and error of avsim-scene",
        "",
        f"`make bench-scene` on {os.cpu_count()} CPUs ({renderer}), load {os.getloadavg()[0]:.1f} at its end; on a "
        "busy machine wall times say little. What is measured, and against what: tests/bench/bench_scene.py.",
        "",
        "| " + " | ".join(heads.values()) + " |",
        "|---" * 2 + "|---:" * (len(heads) - 2) + "|",
    ]
    for row in rows:
        shown = (row.get(key, "") for key in heads)
        lines.append("| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in shown) + " |")
    return "\n".join([*lines, "", "![Run time against error](scene.svg)", ""])


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Run time against error, where matplotlib is installed."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "scene"
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4.5))
    tools: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if "p99.9_mm" in row:
            name = "avcli, 1, 4 and 8 samples" if row["method"].startswith("rounded") else row["method"]
            tools.setdefault(name, []).append(row)
    for number, (name, found) in enumerate(tools.items()):
        for lens, marker in (("kb8", "o"), ("division", "s")):
            points = [(row["cpu_ms"], row["p99.9_mm"]) for row in found if row["lens"] == lens]
            if points:
                axes.loglog(*zip(*points, strict=True), marker, color=f"C{number}", label=f"{name}, {lens}")
    axes.set(xlabel="CPU ms a frame (1920 x 1080, three people)", ylabel="99.9 % depth error, mm")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
