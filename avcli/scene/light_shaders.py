"""Shaders of a room that states its materials, windows or lamps (GLSL 3.30): light of any lamps, windows and the sun.

Lamps and windows are parallelograms: a middle and two half edges. `interior` says how many there are and which of them
are windows; `look_shaders` paints the surfaces.
"""

from collections.abc import Iterable

from avcli.scene import look_shaders, room_shaders, shaders
from avcli.scene.shaders import LENS

_LIGHTS = """
// Of a branch llvmpipe runs both sides, of a loop only the turns that some pixel of a few neighbours needs.
#define ONLY(condition) for (int turn_ = 0; turn_ < int(condition); ++turn_)
uniform vec3 lamps[MOST], lamp_u[MOST], lamp_v[MOST], lamp_light[MOST];
uniform int lamp_count, first_window, glints;   // glints: lamps that shine on skin and cloth
uniform vec3 ambient, sun_way, sun_light;
uniform float exposure, outside;

float luma(vec3 c) { return dot(c, vec3(0.30, 0.59, 0.11)); }
// Light that reaches p from the point q of lamp or window k; nothing stands between.
vec3 arriving(vec3 p, vec3 n, int k, vec3 q) {
    vec3 way = q - p, face = cross(lamp_u[k], lamp_v[k]);
    float square = dot(way, way), cosine = dot(n, way) * inversesqrt(max(square, 1e-6));
    if (k < first_window) return lamp_light[k] * (2.7 * max(cosine + 0.08, 0.0) / (square + 1.5));
    float area = 4.0 * length(face), leaving = -dot(face, way) * inversesqrt(max(square * dot(face, face), 1e-9));
    return lamp_light[k] * (area * max(cosine, 0.0) * max(leaving, 0.0) / (square + 0.25 * area));
}
vec3 open_light(vec3 p, vec3 n) {
    vec3 sum = ambient * sky(n);
    for (int k = 0; k < lamp_count; ++k) sum += arriving(p, n, k, lamps[k]);
    return sum;
}
// How much of lamp or window k a ray meets, whose edge is soft by so many metres for each of its way; s: its way.
float meets(vec3 p, vec3 d, int k, float soft, out float s) {
    vec3 face = cross(lamp_u[k], lamp_v[k]);
    float facing = dot(d, face);
    s = dot(lamps[k] - p, face) / (abs(facing) > 1e-9 ? facing : 1e-9);
    vec3 off = p + s * d - lamps[k];
    vec2 wide = vec2(length(lamp_u[k]), length(lamp_v[k]));
    vec2 at = abs(vec2(dot(off, lamp_u[k]), dot(off, lamp_v[k])) / wide), blur = vec2(max(soft * s, 1e-3));
    vec2 inside = clamp((wide + 0.5 * blur - at) / blur, 0.0, 1.0) * min(2.0 * wide / blur, 1.0);
    return s > 1e-3 && facing < 0.0 ? inside.x * inside.y : 0.0;
}
"""

_CORNERS = """
// Corners of the room see less of what comes from everywhere.
float cornered(vec3 p, vec3 n) {
    vec3 gap = min(p, room - p) + abs(n) * 9.0;
    return 1.0 - 0.45 * exp(-3.0 * min(gap.x, min(gap.y, gap.z)));
}
// The light of the coarse grid is kept as the share of the open light that arrives.
float unblocked(vec3 p, vec3 n) { return 1.0; }
"""

# Light on the room's surfaces past the furniture, as ROOM_LIGHT has it.
_ROOM_LIGHT_MAIN = """
uniform sampler2D seen, surface;
uniform int coarse;
out float light;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy) * coarse + coarse / 2;
    vec2 hit = texelFetch(seen, at, 0).rg;
    light = 0.0;
    if (hit.y < 0.5) return;
    vec3 n = texelFetch(surface, at, 0).xyz;
    vec3 p = eye + hit.x * (to_room * ray_of(at)) + 2e-3 * n, sum = vec3(0.0);
    float turn = 6.2832 * hash(vec3(gl_FragCoord.xy, 1.0)), ring = hash(vec3(gl_FragCoord.yx, 2.0));
    // A lamp of which less than `least` arrives is not asked what stands before it.
    float all = luma(open_light(p, n)), least = 0.02 * all;
    for (int k = 0; k < lamp_count; ++k) {
        vec3 whole = arriving(p, n, k, lamps[k]);
        bool counts = luma(whole) > least;
        sum += counts ? vec3(0.0) : whole;
        ONLY(counts) {
            vec3 to[RAYS], ways[RAYS];
            float far[RAYS], open[RAYS];
            for (int s = 0; s < RAYS; ++s) {
                float f = float(s) + hash(vec3(gl_FragCoord.xy, 3.0 + float(s + 5 * k)));
                vec2 at = 2.0 * vec2(f / float(RAYS), fract(f * 1.618 + ring)) - 1.0;
                to[s] = lamps[k] + at.x * lamp_u[k] + at.y * lamp_v[k];
                far[s] = length(to[s] - p);
                ways[s] = (to[s] - p) / far[s];
                far[s] -= 0.02;
                open[s] = 1.0;
            }
            block_RAYS(p, ways, far, open);
            for (int s = 0; s < RAYS; ++s) sum += open[s] * arriving(p, n, k, to[s]) / float(RAYS);
        }
    }
    vec3 u = normalize(cross(n, abs(n.z) < 0.9 ? vec3(0, 0, 1) : vec3(1, 0, 0))), v = cross(n, u), ways[5];
    float far[5], open[5];
    for (int s = 0; s < 5; ++s) {
        float r = sqrt((float(s) + ring) / 5.0), a = turn + 2.39996 * float(s);
        ways[s] = r * cos(a) * u + r * sin(a) * v + sqrt(1.0 - r * r) * n;
        far[s] = 0.9;
        open[s] = 0.2;
    }
    block_5(p, ways, far, open);
    float sky_seen = open[0] + open[1] + open[2] + open[3] + open[4];
    light = luma(sum + sky_seen * cornered(p, n) * ambient * sky(n)) / max(all, 1e-3);
}
"""

# A look is three texels: ground + pattern, second + whether it is a factor of the ground, size + contrast + gloss.
# The first six are the room's faces, then the materials of furniture by their numbers.
_SHADE = """
uniform sampler2D looks;

// Where a point lies on a solid's face: along the face's two edges in m, and the half sizes of a box's face.
void on_solid(int index, vec3 p, vec3 n, out vec3 local, out vec2 q, out vec2 half_size, out vec3 u, out vec3 v) {
    vec4 c = solid_texel(index, 0), x = solid_texel(index, 1), y = solid_texel(index, 2), z = solid_texel(index, 3);
    bool mesh = c.w > 2.5;
    mat3 axes = mesh ? mat3(1.0) : mat3(x.xyz, y.xyz, z.xyz);
    vec3 reach = mesh ? vec3(0.0) : vec3(x.w, y.w, z.w), ln = n * axes;
    local = (p - c.xyz) * axes;
    half_size = vec2(0.0);
    if (c.w > 0.5 && c.w < 1.5 && abs(ln.z) < 0.5) {
        q = vec2(atan(local.y, local.x) * reach.x, local.z);
        v = axes[2];
        u = normalize(cross(v, n));
        return;
    }
    vec3 size = abs(ln);
    int i = size.x > size.y && size.x > size.z ? 1 : 0, j = size.z >= size.x && size.z >= size.y ? 1 : 2;
    float way = j == 1 ? 1.0 : sign(ln[3 - i - j]) * (i == 1 ? 1.0 : -1.0);
    if (j == 1 && reach[0] < reach[1]) { i = 1; j = 0; }
    q = vec2(way * local[i], local[j]);
    half_size = c.w < 0.5 ? vec2(reach[i], reach[j]) : vec2(0.0);
    u = way * axes[i];
    v = axes[j];
}

// How much of the sun a window lets through to p, past its middle bar; far: how far the window is.
float sun_open(vec3 p, float blur, out float far) {
    float most = 0.0, s;
    far = 0.0;
    for (int k = first_window; k < lamp_count; ++k) {
        float in_frame = meets(p, sun_way, k, 0.0093 + blur, s);
        float bar = dot(p + s * sun_way - lamps[k], lamp_u[k]) / length(lamp_u[k]);
        in_frame *= smoothstep(0.015, 0.035, abs(bar));
        if (in_frame > most) { most = in_frame; far = s; }
    }
    return most;
}

vec3 mirrored(vec3 p, vec3 r, float rough) {
    vec3 sum = 0.35 * ambient;
    float s;
    for (int k = 0; k < lamp_count; ++k) {
        float bright = k < first_window ? 1.2 / length(cross(lamp_u[k], lamp_v[k])) : 3.1;
        sum += meets(p, r, k, rough, s) * min(bright, 12.0) * lamp_light[k];
    }
    return sum;
}

vec3 shade(vec2 px, vec3 d, float t, int id, vec3 n) {
    vec3 p = eye + t * d, u = id < 3 ? vec3(0, 1, 0) : vec3(1, 0, 0), v = id > 4 ? vec3(0, 1, 0) : vec3(0, 0, 1);
    vec3 place = p, base = vec3(0.0), bent = n, own = vec3(1.0), glow = vec3(0.0);
    vec2 q = vec2(dot(p, u), dot(p, v)), half_size = vec2(0.0), bump = vec2(0.0);
    float seed = 7.3 * float(id);
    int row = id - 1, material = 9;
    if (id > FACES) {
        int index = id - 1 - FACES;
        material = int(solid_texel(index, 4).w + 0.5);
        row = FACES + material;
        own = solid_texel(index, 4).rgb;
        seed = 1.37 * float(index);
        on_solid(index, p, n, place, q, half_size, u, v);
        place += 3.1 * seed;
    }
    vec4 first = texelFetch(looks, ivec2(0, row), 0), other = texelFetch(looks, ivec2(1, row), 0);
    vec4 rest = texelFetch(looks, ivec2(2, row), 0);
    float gloss = rest.w, facing = max(dot(-d, n), 0.0), blur = 1.2 * t * per_px.x / max(facing, 0.08);
    vec3 ground = id > FACES ? own : first.rgb, second = other.w > 0.5 ? ground * other.rgb : other.rgb;
    ONLY(first.w >= 0.0) {
        Look look = Look(ground, second, rest.xy, rest.z, rest.w, seed);
        base = paint(int(first.w + 0.5), look, place, q, half_size, d, blur, bump, gloss, glow);
    }
    ONLY(first.w < 0.0 && id > FACES) base = solid_colour(id - 1 - FACES, p);
    ONLY(first.w < -1.5 && id <= FACES) base = plain_colour(int(-1.5 - first.w), ground, p);
    ONLY(first.w == -1.0 && id == 5) base = floor_colour(p.xy, blur);
    ONLY(first.w == -1.0 && id == 6) base = vec3(0.72);
    ONLY(first.w == -1.0 && id < 5) base = curtain(p, id, bent);
    bent = normalize(bent - bump.x * u - bump.y * v);
    vec3 light = light_at(px, id, p, n) * open_light(p, bent);
    SUNSHINE
    ONLY(gloss > 0.01) {
        float grazing = 0.04 + 0.96 * pow(1.0 - max(dot(-d, bent), 0.0), 5.0);
        float rough = 0.03 + 0.3 * (1.0 - gloss) * (1.0 - gloss);
        vec3 r = reflect(d, normalize(mix(n, bent, 0.3)));
        glow += min(1.5 * gloss, 1.0) * grazing * mirrored(p + 1e-3 * n, r, rough);
    }
    return display(exposure * (base * light + glow));
}
"""

_SUN = """
    float far, sun = sun_open(p, 0.5 * blur, far) * max(dot(bent, sun_way), 0.0);
    ONLY(sun > 1e-3) {
        float open[1] = float[1](sun);
        block_1(p + 3e-3 * n, vec3[1](sun_way), float[1](far - 0.08), open);
        light += open[0] * sun_light;
    }
"""

# Light in the room's air, where people are: from six directions in each cell of a grid (J. McTaggart, 2004).
_PROBE_MAIN = """
uniform vec3 cells;
layout(location = 0) out vec4 light[6];
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), count = ivec2(cells.xy);
    vec3 p = (vec3(at.x, at.y % count.y, at.y / count.y) + 0.5) / cells * room, sums[6];
    for (int side = 0; side < 6; ++side) sums[side] = vec3(0.0);
    for (int k = 0; k < lamp_count; ++k) {
        vec3 to[4], ways[4];
        float far[4], open[4];
        for (int s = 0; s < 4; ++s) {
            to[s] = lamps[k] + (float(s & 1) - 0.5) * lamp_u[k] + (float(s >> 1) - 0.5) * lamp_v[k];
            far[s] = length(to[s] - p);
            ways[s] = (to[s] - p) / far[s];
            far[s] -= 0.02;
            open[s] = 0.25;
        }
        block_4(p, ways, far, open);
        for (int s = 0; s < 4; ++s) for (int side = 0; side < 6; ++side) {
            vec3 n = vec3(0.0);
            n[side / 2] = (side & 1) == 0 ? 1.0 : -1.0;
            sums[side] += open[s] * arriving(p, n, k, to[s]);
        }
    }
    for (int side = 0; side < 6; ++side) light[side] = vec4(sums[side], 1.0);
}
"""

_LIT = """
uniform sampler3D probes;
uniform vec3 cells, room;
vec3 probe(vec3 p, vec3 n) {
    vec3 at = clamp(p / room * cells, vec3(0.5), cells - 0.5) / cells, part = n * n;
    vec3 side = (vec3(0.0, 2.0, 4.0) + vec3(lessThan(n, vec3(0.0))) + at.z) / 6.0;
    return part.x * texture(probes, vec3(at.xy, side.x)).rgb + part.y * texture(probes, vec3(at.xy, side.y)).rgb
         + part.z * texture(probes, vec3(at.xy, side.z)).rgb;
}
vec3 lit(vec3 albedo, float gloss, vec3 at, vec3 n, vec3 toward, float open) {
    vec3 direct = probe(at + 0.05 * n, n), shine = vec3(0.0);
    vec3 light = open * ambient * sky(n) * (0.75 + 0.25 * smoothstep(0.0, 0.9, at.z)) + (0.35 + 0.65 * open) * direct;
    for (int k = 0; k < glints; ++k) {
        float glint = max(dot(n, normalize(normalize(lamps[k] - at) + toward)), 0.0);
        glint *= glint; glint *= glint; glint *= glint; glint *= glint;
        shine += glint * glint * lamp_light[k];
    }
    return display(exposure * (albedo * light * 1.08 + gloss * shine * 0.35));
}
"""

# People's shadows, as SHADOW_FRAGMENT has them, of all lamps and windows and as far as `reach`.
_SHADOW_MAIN = """
flat in ivec2 mine;
uniform sampler2D seen, surface, balls;
uniform mat3 to_room;
uniform vec3 eye;
uniform int coarse;
uniform float reach;
out float factor;
void main() {
    ivec2 at = min(ivec2(gl_FragCoord.xy) * coarse + coarse / 2, textureSize(seen, 0) - 1);
    vec2 hit = texelFetch(seen, at, 0).rg;
    if (hit.y < 0.5) discard;
    vec3 p = eye + hit.x * (to_room * ray_of(at)), n = texelFetch(surface, at, 0).xyz;
    vec4 foot = texelFetch(balls, ivec2(mine.x + 3, 0), 0);
    float away = distance(foot.xy, p.xy);
    if (away > reach) discard;
    float open = 1.0, all = luma(ambient * sky(n)), left;
    for (int j = mine.x; j < mine.y; ++j) {
        vec4 ball = texelFetch(balls, ivec2(j, 0), 0);
        vec3 way = ball.xyz - p;
        float square = max(dot(way, way), ball.w * ball.w), r2 = ball.w * ball.w;
        open *= 1.0 - 0.85 * max(dot(n, way), 0.0) * inversesqrt(square) * r2 / square;
    }
    left = open * all;
    for (int k = 0; k < lamp_count; ++k) {
        vec3 way = lamps[k] - p;
        float far = length(way), wide = sqrt(length(cross(lamp_u[k], lamp_v[k]))) / far, clear = 1.0;
        way /= far;
        for (int j = mine.x; j < mine.y; ++j) {
            vec4 ball = texelFetch(balls, ivec2(j, 0), 0);
            vec3 middle = ball.xyz - p;
            float along = dot(middle, way), aside = sqrt(max(dot(middle, middle) - along * along, 0.0));
            float soft = max(along, 0.0) * wide + 0.02, cover = 1.0 - smoothstep(ball.w - soft, ball.w + soft, aside);
            if (along > 0.0) clear *= 1.0 - cover * min(1.0, ball.w * ball.w / (soft * soft));
        }
        float light = luma(arriving(p, n, k, lamps[k]));
        all += light;
        left += clear * light;
    }
    factor = mix(1.0, sqrt(left / max(all, 1e-4)), smoothstep(reach, 0.6 * reach, away));
}
"""


MOST_LIGHTS = 80
"""Lamps and windows together, as many as room_config may have."""


class Shaders:
    """The fragment shaders of one interior.

    Args:
        patterns: that its surfaces and furniture have.
        lamp_rays: to each lamp or window from one place.
        sun: whether the sun shines.
    """

    def __init__(self, patterns: Iterable[str], lamp_rays: int, *, sun: bool) -> None:
        lights = f"#define MOST {MOST_LIGHTS}\n" + shaders.NOISE + _LIGHTS
        solid, blocked = room_shaders.SOLID, room_shaders.blocked
        shade = _SHADE.replace("SUNSHINE", _SUN if sun else "")
        paint = (
            LENS
            + solid
            + lights
            + _CORNERS
            + (blocked(1) if sun else "")
            + room_shaders.PAINT
            + look_shaders.paint(patterns)
            + shade
        )
        light = _ROOM_LIGHT_MAIN.replace("RAYS", str(lamp_rays))
        self.room_light = LENS + solid + lights + _CORNERS + blocked(*{5, lamp_rays}) + light
        self.room_shade = paint + room_shaders.SHADE_MAIN
        self.room_smooth = paint + room_shaders.SMOOTH_MAIN
        self.probe = "#version 330\n" + solid + lights + blocked(4) + _PROBE_MAIN
        self.shadow = LENS + lights + _SHADOW_MAIN
        self.people = LENS + shaders.CONE + lights + _LIT + shaders.PAINT + shaders.SHADE_MAIN
