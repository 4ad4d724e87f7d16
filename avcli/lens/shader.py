"""A lens for the graphics card: GLSL that turns pixels into rays, and the numbers that it needs.

The exact inverse of a radial lens is a loop; here it is a Chebyshev series each for the lateral and the axial part of
the ray, exact to 3e-8, fitted to what its `ray_parts` returns. Tangential terms are taken off the image point first:
that is a fixed point of a few turns, in each of which the series gives the undistorted point. Any `Lens` works.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from avcli.lens.models import Angular, Lens

GLSL = """#version 330
uniform vec2 centre, per_px, stretch;   // principal point, px to the lens's plane, and back to slopes (division)
uniform vec4 domain;                    // 1 / m_top^2, whether the variable is sqrt(1 - .), m_max^2, source bound
uniform vec2 series[SEGMENTS * TERMS];  // Chebyshev coefficients of the lateral and the axial part of the ray

uniform sampler2D rays;                 // stored_ray of each pixel's centre

// The two parts of the unit ray through point m of the lens's plane, without tangential terms: what times m, and its z;
// 0, 0 where the lens images nothing.
vec2 parts_at(vec2 m) {
    float square = dot(m, m);
    float w = square * domain.x;
    if (domain.y > 0.5) w = sqrt(max(1.0 - w, 0.0));
#if SEGMENTS > 1
    w = clamp(w, 0.0, 1.0) * SEGMENTS;
    int first = min(int(w), SEGMENTS - 1);
    w = 2.0 * (w - float(first)) - 1.0;
    first *= TERMS;
#else
    const int first = 0;
    w = 2.0 * w - 1.0;
#endif
    vec2 one = vec2(0.0), two = vec2(0.0);   // Clenshaw's recurrence
    for (int i = TERMS - 1; i > 0; --i) {
        vec2 sum = 2.0 * w * one - two + series[first + i];
        two = one;
        one = sum;
    }
    vec2 ab = w * one - two + series[first];
    float a = ab.x, b = ab.y;
    vec2 lateral = m * a;
    if (square > domain.z || (domain.w > 0.5 && max(abs(lateral.x), abs(lateral.y)) > 1.0)) return vec2(0.0);
    return vec2(a, b) / length(vec3(lateral * stretch, b));
}
#if TURNS > 0
uniform vec4 tangent;                   // p and a of avcli.lens.tangential
uniform float angular;                  // whether the lens bends angles (1) or slopes (0)
vec3 ray_through(vec2 px) {
    vec2 w = (px - centre) * per_px, m = w, parts = parts_at(m);
    for (int i = 0; i < TURNS; ++i) {
        float size = length(m), lateral = size * parts.x;
        float s = angular > 0.5 ? atan(lateral, parts.y) : lateral / parts.y;
        vec2 q = size > 1e-6 ? m * (s / size) : m;
        m = w - dot(q, q) * tangent.zw - 2.0 * dot(q, tangent.xy) * q;
        parts = parts_at(m);
        if (parts == vec2(0.0)) break;
    }
    return vec3(m * parts.x, parts.y);
}
vec3 ray_of(ivec2 at) { return texelFetch(rays, at, 0).rgb; }
vec4 stored_ray(vec2 px) { return vec4(ray_through(px), 0.0); }
#else
vec2 ray_parts(vec2 px) { return parts_at((px - centre) * per_px); }
vec3 ray_from(vec2 px, vec2 parts) { return vec3((px - centre) * per_px * stretch * parts.x, parts.y); }
vec3 ray_through(vec2 px) { return ray_from(px, ray_parts(px)); }
vec3 ray_of(ivec2 at) { return ray_from(vec2(at), texelFetch(rays, at, 0).rg); }
vec4 stored_ray(vec2 px) { return vec4(ray_parts(px), 0.0, 0.0); }
#endif
"""
"""`specialised` fills in SEGMENTS and TERMS of the series, and TURNS, in which tangential terms are taken off."""

_MOST_TERMS = 100  # 10 to 25 are usual; a steep Brown-Conrady polynomial takes 80
_SEGMENTS, _SEGMENT_TERMS = 16, 14  # of a lens for which these do not do: slopes that a rational polynomial bends
_ENOUGH = 3e-8  # error of the series: half a float32 step of a unit ray
_NODES = 400
_TURNS = 12  # each makes the error of a tangential lens some 100 times smaller, near its edge 3 times
_REACH = 1.5  # of the series over the image's half diagonal: bodies are counted beyond the image too


def uniforms(lens: Lens, width: int, height: int) -> dict[str, Any]:
    """Compute what `GLSL` needs to turn the pixels of an image into rays.

    The variable of the series is the squared radius, or, where the lens folds within the series' reach, the root of the
    distance to the fold, in which the ray is smooth.

    Args:
        lens: any lens model.
        width, height: size of the image, px.

    Returns:
        The uniforms by name.
    """
    whole, lens = lens, lens.radial
    per_px = 1.0 / np.array(lens.scale_px)
    x = np.maximum(abs(lens.cx + 0.5), abs(width - 0.5 - lens.cx)) * per_px[0]
    y = np.maximum(abs(lens.cy + 0.5), abs(height - 0.5 - lens.cy)) * per_px[1]
    top = min((1.0 if lens.is_bounded else _REACH) * np.hypot(x, y), lens.radius_max)
    bent = any(whole.tangential_terms)
    field = min(top, whole.radius_max) if bent else top
    ends = top == lens.radius_max and lens.has_fold

    def wanted(w: np.ndarray) -> np.ndarray:
        return lens.ray_parts(top * np.sqrt((1 - w) * (1 + w)) if ends else top * np.sqrt(w))

    series, error = _series(wanted, 1, range(2, _MOST_TERMS + 1))
    if error > _ENOUGH:
        series, _ = _series(wanted, _SEGMENTS, range(_SEGMENT_TERMS, _SEGMENT_TERMS + 1))
    tangent = {"tangent": whole.tangential_terms, "angular": float(isinstance(lens, Angular))} if bent else {}
    return {
        **tangent,
        "centre": (lens.cx, lens.cy), "per_px": tuple(per_px), "stretch": lens.slopes_per_unit,
        "domain": (1.0 / top**2, float(ends), field**2, float(lens.is_bounded)),
        "series": series.reshape(-1, 2).tolist(), "segments": len(series),
    }  # fmt: skip


def specialised(source: str, values: dict[str, Any]) -> str:
    """Put into a shader's source what depends on the lens, of which `values` are the uniforms."""
    segments = values["segments"]
    numbers = {
        "SEGMENTS": segments, "TERMS": len(values["series"]) // segments, "TURNS": _TURNS * ("tangent" in values),
    }  # fmt: skip
    for name, number in numbers.items():
        source = source.replace(name, str(number))
    return source


def _series(
    wanted: Callable[[np.ndarray], np.ndarray], segments: int, terms: Sequence[int]
) -> tuple[np.ndarray, float]:
    """Fit Chebyshev series to (n, 2) values over even segments of [0, 1], with the first of `terms` that is enough.

    The polynomials are orthogonal on the nodes (J. C. Mason and D. C. Handscomb, 2003, eq. 4.42): each coefficient is a
    sum over them, and stays when terms follow.

    Returns:
        (segments, terms, 2) coefficients, and the largest error.
    """
    turn = np.pi * (np.arange(_NODES) + 0.5) / _NODES
    polynomials = np.cos(np.outer(np.arange(max(terms)), turn - np.pi))
    node = 0.5 - 0.5 * np.cos(turn)
    values = np.stack([wanted((first + node) / segments) for first in range(segments)])
    series = 2 / _NODES * polynomials @ values
    series[:, 0] /= 2
    for count in terms:
        error = float(np.abs(polynomials[:count].T @ series[:, :count] - values).max())
        if error < _ENOUGH:
            break
    return series[:, :count], error
