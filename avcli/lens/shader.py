"""A lens for the graphics card: GLSL that turns pixels into rays, and the numbers that it needs.

The exact inverse of a lens is a loop; here it is a Chebyshev series each for the lateral and the axial part of the ray,
exact to 3e-8. Any `Lens` works: the series is fitted to what its `ray_parts` returns.
"""

from typing import Any

import numpy as np

from avcli.lens.models import Lens

GLSL = """#version 330
uniform vec2 centre, per_px, stretch;   // principal point, px to the lens's plane, and back to slopes (division)
uniform vec4 domain;                    // 1 / m_top^2, whether the variable is sqrt(1 - .), m_max^2, source bound
uniform vec2 series[TERMS];             // Chebyshev coefficients of the lateral and the axial part of the ray

uniform sampler2D rays;                 // ray_parts of each pixel's centre

// The two parts of the unit ray through image point px, which times its place in the lens's plane, and its z; 0, 0
// where the lens images nothing.
vec2 ray_parts(vec2 px) {
    vec2 m = (px - centre) * per_px;
    float square = dot(m, m);
    float w = square * domain.x;
    if (domain.y > 0.5) w = sqrt(max(1.0 - w, 0.0));
    w = 2.0 * w - 1.0;
    vec2 one = vec2(0.0), two = vec2(0.0);   // Clenshaw's recurrence
    for (int i = TERMS - 1; i > 0; --i) {
        vec2 sum = 2.0 * w * one - two + series[i];
        two = one;
        one = sum;
    }
    vec2 ab = w * one - two + series[0];
    float a = ab.x, b = ab.y;
    vec2 lateral = m * a;
    if (square > domain.z || (domain.w > 0.5 && max(abs(lateral.x), abs(lateral.y)) > 1.0)) return vec2(0.0);
    return vec2(a, b) / length(vec3(lateral * stretch, b));
}
vec3 ray_from(vec2 px, vec2 parts) { return vec3((px - centre) * per_px * stretch * parts.x, parts.y); }
vec3 ray_through(vec2 px) { return ray_from(px, ray_parts(px)); }
vec3 ray_of(ivec2 at) { return ray_from(vec2(at), texelFetch(rays, at, 0).rg); }
"""
"""TERMS stands for the number of terms of the series."""

_MOST_TERMS = 100  # 10 to 25 are usual; a steep Brown-Conrady polynomial takes 80
_ENOUGH = 3e-8  # error of the series: half a float32 step of a unit ray
_NODES = 400
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
    per_px = 1.0 / np.array(lens.scale_px)
    x = np.maximum(abs(lens.cx + 0.5), abs(width - 0.5 - lens.cx)) * per_px[0]
    y = np.maximum(abs(lens.cy + 0.5), abs(height - 0.5 - lens.cy)) * per_px[1]
    top = min((1.0 if lens.is_bounded else _REACH) * np.hypot(x, y), lens.radius_max)
    ends = top == lens.radius_max and lens.has_fold
    node = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    wanted = lens.ray_parts(top * np.sqrt((1 - node) * (1 + node)) if ends else top * np.sqrt(node))
    for terms in range(2, _MOST_TERMS + 1):
        series = np.polynomial.chebyshev.chebfit(2 * node - 1, wanted, terms - 1)
        if np.abs(np.polynomial.chebyshev.chebval(2 * node - 1, series).T - wanted).max() < _ENOUGH:
            break
    return {
        "centre": (lens.cx, lens.cy), "per_px": tuple(per_px), "stretch": lens.slopes_per_unit,
        "domain": (1.0 / top**2, float(ends), top**2, float(lens.is_bounded)), "series": series.tolist(),
    }  # fmt: skip
