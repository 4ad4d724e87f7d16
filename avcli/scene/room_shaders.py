"""The shaders that draw the room and its furniture, once a scene (GLSL 3.30; see shaders)."""

from avcli.scene.shaders import CORNER, LENS, LIGHT, TABLE

ROOM_VERTEX = (
    CORNER
    + """
in float solid;
flat out int index;
void main() { gl_Position = corner(); index = int(solid); }
"""
)

# A solid is five texels: centre + kind, three axes (+ half sizes), colour + material.
SOLID = (
    TABLE
    + """
uniform sampler2D solids;
uniform mat3 to_room;        // camera frame to room
uniform vec3 eye, room;      // camera's place and the room's size, m
const int FACES = 6;

vec4 solid_texel(int index, int part) { return texelFetch(solids, table_place(index, part, 5), 0); }

// Distance from o along d to a solid and the normal there (room frame); negative where it is missed.
float hit_solid(vec3 o, vec3 d, int index, out vec3 normal) {
    vec4 c = solid_texel(index, 0), x = solid_texel(index, 1), y = solid_texel(index, 2), z = solid_texel(index, 3);
    normal = vec3(0.0);
    if (c.w > 2.5) {
        vec3 e1 = x.xyz - c.xyz, e2 = y.xyz - c.xyz, s = o - c.xyz, h = cross(d, e2);
        float det = dot(e1, h);
        if (abs(det) < 1e-12) return -1.0;
        float u = dot(s, h) / det;
        vec3 q = cross(s, e1);
        float v = dot(d, q) / det;
        if (u < -1e-5 || v < -1e-5 || u + v > 1.0 + 1e-5) return -1.0;
        normal = normalize(cross(e1, e2));
        if (dot(normal, d) > 0.0) normal = -normal;
        return dot(e2, q) / det;
    }
    mat3 axes = mat3(x.xyz, y.xyz, z.xyz);
    vec3 half_size = vec3(x.w, y.w, z.w), lo = (o - c.xyz) * axes, ld = d * axes;
    if (c.w > 1.5) {
        float start = -dot(lo, ld);
        vec3 p = lo + start * ld;
        float h = half_size.x * half_size.x - dot(p, p);
        if (h < 0.0) return -1.0;
        float t = start - sqrt(h);
        normal = axes * ((lo + t * ld) / half_size.x);
        return t;
    }
    vec3 safe = mix(ld, vec3(1e-20), lessThan(abs(ld), vec3(1e-20)));
    vec3 near3 = -lo / safe - abs(half_size / safe), far3 = -lo / safe + abs(half_size / safe);
    vec3 facing = -sign(ld);
    if (c.w > 0.5) {
        float a = dot(ld.xy, ld.xy), mid = -dot(lo.xy, ld.xy) / max(a, 1e-12);
        vec2 p = lo.xy + mid * ld.xy;
        float h = half_size.x * half_size.x - dot(p, p);
        if (h < 0.0) return -1.0;
        float reach = sqrt(h / max(a, 1e-12)), enter = max(mid - reach, near3.z), leave = min(mid + reach, far3.z);
        if (enter > leave || leave < 0.0) return -1.0;
        bool side = mid - reach > near3.z;
        normal = axes * (side ? vec3((lo.xy + enter * ld.xy) / half_size.x, 0.0) : vec3(0.0, 0.0, facing.z));
        return enter;
    }
    float enter = max(near3.x, max(near3.y, near3.z)), leave = min(far3.x, min(far3.y, far3.z));
    if (enter > leave || leave < 0.0) return -1.0;
    normal = axes * (facing * step(near3.yzx, near3.xyz) * step(near3.zxy, near3.xyz));
    return enter;
}

// Distance from a point in the room to its walls, and which: 1..6 for x = 0, x = X, y = 0, y = Y, z = 0, z = Z.
float hit_room(vec3 o, vec3 d, out int face) {
    vec3 safe = mix(d, vec3(1e-20), lessThan(abs(d), vec3(1e-20)));
    vec3 t = (mix(vec3(0.0), room, step(0.0, safe)) - o) / safe;
    float nearest = min(t.x, min(t.y, t.z));
    if (nearest == t.x) face = d.x > 0.0 ? 2 : 1;
    else if (nearest == t.y) face = d.y > 0.0 ? 4 : 3;
    else face = d.z > 0.0 ? 6 : 5;
    return nearest;
}

vec3 face_normal(int face) {
    vec3 n = vec3(0.0);
    n[(face - 1) / 2] = (face & 1) == 1 ? 1.0 : -1.0;
    return n;
}
"""
)

ROOM_FRAGMENT = (
    LENS
    + SOLID
    + """
flat in int index;
uniform float far;
layout(location = 0) out vec2 seen;
layout(location = 1) out vec4 surface;
void main() {
    vec3 ray = ray_of(ivec2(gl_FragCoord.xy));
    if (ray == vec3(0.0)) discard;
    vec3 d = to_room * ray, normal;
    float t;
    int id;
    if (index < 0) {
        t = hit_room(eye, d, id);
        normal = face_normal(id);
    } else {
        t = hit_solid(eye, d, index, normal);
        id = index + 1 + FACES;
        if (t <= 0.0) discard;
    }
    seen = vec2(t, float(id));
    surface = vec4(normal, 1.0);
    gl_FragDepth = clamp(t / far, 0.0, 1.0);
}
"""
)

_BLOCKED = """
// Which of COUNT rays from o furniture stands before, until they have gone as far as `far`: `open` of these becomes 0.
// Each thing is read once for all rays, and examined where a ball around it comes near one of them.
void block_COUNT(vec3 o, vec3 d[COUNT], float far[COUNT], inout float open[COUNT]) {
    for (int k = blockers_from; k < blockers_from + blockers; ++k) {
        vec4 c = solid_texel(k, 0);
        float radius = solid_texel(k, 4).w, near = 0.0;
        vec3 from = o - c.xyz;
        float square = dot(from, from) - radius * radius;
        for (int s = 0; s < COUNT; ++s) {
            float along = dot(from, d[s]);
            near += square < along * along && -along - radius < far[s] && along < radius ? open[s] : 0.0;
        }
        for (int turn = 0; turn < int(near > 0.0); ++turn) {   // a loop: llvmpipe runs both sides of a branch
            vec4 x = solid_texel(k, 1), y = solid_texel(k, 2), z = solid_texel(k, 3);
            vec3 reach = vec3(x.w, y.w, z.w);
            mat3 axes = mat3(x.xyz, y.xyz, z.xyz);
            vec3 lo = from * axes;
            for (int s = 0; s < COUNT; ++s) {
                vec3 ld = d[s] * axes;
                float along = dot(from, d[s]), h = along * along - dot(lo, lo) + reach.x * reach.x;
                float ball = -along - sqrt(max(h, 0.0));
                bool in_ball = h > 0.0 && ball > 1e-3 && ball < far[s];
                ld = mix(ld, vec3(1e-20), lessThan(abs(ld), vec3(1e-20)));
                vec3 near3 = -lo / ld - abs(reach / ld), far3 = -lo / ld + abs(reach / ld);
                float enter = max(near3.x, max(near3.y, near3.z)), leave = min(far3.x, min(far3.y, far3.z));
                bool in_box = enter < leave && enter > 1e-3 && enter < far[s];
                if (c.w > 1.5 ? in_ball : in_box) open[s] = 0.0;
            }
        }
    }
}
"""


def blocked(*counts: int) -> str:
    """The GLSL of `block_N`, which tells what furniture stands before N rays from one place, for each N of `counts`."""
    head = "uniform int blockers, blockers_from;   // rows of the table of solids\n"
    return head + "".join(_BLOCKED.replace("COUNT", str(count)) for count in counts)


# How much light reaches the room's surfaces, on a coarse grid: lamps behind furniture, and the open sky above.
ROOM_LIGHT = (
    LENS
    + SOLID
    + LIGHT
    + blocked(11)
    + """
uniform sampler2D seen, surface;
uniform int coarse;
out float light;

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy) * coarse + coarse / 2;
    vec2 hit = texelFetch(seen, at, 0).rg;
    light = 0.0;
    if (hit.y < 0.5) return;
    vec3 n = texelFetch(surface, at, 0).xyz;
    vec3 p = eye + hit.x * (to_room * ray_of(at)) + 2e-3 * n;
    float turn = 6.2832 * hash(vec3(gl_FragCoord.xy, 1.0)), ring = hash(vec3(gl_FragCoord.yx, 2.0));
    // Three rays to each lamp, and five to the sky.
    vec3 ways[11];
    float far[11], open[11];
    for (int s = 0; s < 6; ++s) {
        float r = LAMP_RADIUS * sqrt((float(s % 3) + ring) / 3.0), a = turn + 2.39996 * float(s % 3);
        ways[s] = lamps[s / 3] + r * vec3(cos(a), sin(a), 0.0) - p;
        far[s] = length(ways[s]);
        ways[s] /= far[s];
        open[s] = 1.0 / 3.0;
    }
    vec3 u = normalize(cross(n, abs(n.z) < 0.9 ? vec3(0, 0, 1) : vec3(1, 0, 0))), v = cross(n, u);
    for (int s = 0; s < 5; ++s) {
        float r = sqrt((float(s) + ring) / 5.0), a = turn + 2.39996 * float(s);
        ways[s + 6] = r * cos(a) * u + r * sin(a) * v + sqrt(1.0 - r * r) * n;
        far[s + 6] = 0.9;
        open[s + 6] = 0.2;
    }
    block_11(p, ways, far, open);
    for (int k = 0; k < 2; ++k) light += (open[3 * k] + open[3 * k + 1] + open[3 * k + 2]) * lamp(p, n, k);
    // Corners of the room see less of it.
    vec3 gap = min(p, room - p) + abs(n) * 9.0;
    float corner = 1.0 - 0.45 * exp(-3.0 * min(gap.x, min(gap.y, gap.z)));
    light += (open[6] + open[7] + open[8] + open[9] + open[10]) * corner * sky(n);
}
"""
)

# Averages the coarse light over neighbours on the same surface, and says which surface: light, id, normal's x and y.
ROOM_BLUR = """#version 330
uniform sampler2D seen, surface, light;
uniform int coarse;
out vec4 smoothed;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(light, 0) - 1;
    vec2 hit = texelFetch(seen, at * coarse + coarse / 2, 0).rg;
    vec3 n = texelFetch(surface, at * coarse + coarse / 2, 0).xyz;
    float sum = 0.0, weights = 0.0;
    for (int y = -3; y <= 3; ++y) for (int x = -3; x <= 3; ++x) {
        ivec2 other = clamp(at + ivec2(x, y), ivec2(0), most);
        vec2 seen_there = texelFetch(seen, other * coarse + coarse / 2, 0).rg;
        vec3 m = texelFetch(surface, other * coarse + coarse / 2, 0).xyz;
        float w = seen_there.y == hit.y && dot(m, n) > 0.9 && abs(seen_there.x - hit.x) < 0.25 ? 1.0 : 0.0;
        sum += w * texelFetch(light, other, 0).r;
        weights += w;
    }
    smoothed = vec4(sum / max(weights, 1.0), hit.y, n.xy);
}
"""

# What any room is painted with: its light where it was computed, and the looks of what states no material.
PAINT = """
uniform sampler2D seen, surface, light;
uniform int coarse;
out vec4 colour;

// Light from the coarse grid at a pixel that sees the surface `id` at p.
float light_at(vec2 px, int id, vec3 p, vec3 n) {
    vec2 at = (px + 0.5 - float(coarse / 2) - 0.5) / float(coarse);
    ivec2 base = ivec2(floor(at)), most = textureSize(light, 0) - 1;
    vec2 f = at - vec2(base);
    float sum = 0.0, weights = 0.0;
    for (int y = -1; y <= 2; ++y) for (int x = -1; x <= 2; ++x) {
        ivec2 other = clamp(base + ivec2(x, y), ivec2(0), most);
        vec2 near2 = max(1.0 - 0.6 * abs(vec2(x, y) - f), 0.02);
        vec4 there = texelFetch(light, other, 0);
        float w = near2.x * near2.y, up = sqrt(max(1.0 - dot(there.zw, there.zw), 0.0));
        // One surface's normals that differ in nothing but the sign of z are never seen side by side.
        w *= int(there.y + 0.5) == id && dot(vec3(there.zw, up), vec3(n.xy, abs(n.z))) > 0.9 ? 1.0 : 0.0;
        sum += w * there.x;
        weights += w;
    }
    // A thin face may lie between the samples: then as much of its light is blocked as of its neighbours'. The number
    // of turns is no constant: a loop that is not unrolled ends at once where no pixel needs it.
    int turns = weights > 1e-4 ? 0 : coarse * coarse;
    for (int k = 0; k < turns; ++k) {
        vec4 there = texelFetch(light, clamp(base + ivec2(k % coarse, k / coarse) - 1, ivec2(0), most), 0);
        sum += there.x;
        weights += unblocked(p, vec3(there.zw, sqrt(max(1.0 - dot(there.zw, there.zw), 0.0))));
    }
    return sum / max(weights, 1e-4) * (turns > 0 ? unblocked(p, n) : 1.0);
}

vec3 floor_colour(vec2 p, float blur) {
    vec2 cell = floor(p / 0.6), edge = abs(fract(p / 0.6) - 0.5) * 0.6;
    float seam = smoothstep(0.2985 - blur, 0.2985 + 0.2 * blur, max(edge.x, edge.y)) * min(1.0, 0.003 / blur);
    float tone = 0.95 + 0.05 * hash(vec3(cell, 3.0)) + 0.06 * (noise(vec3(p * 7.0, 0.0)) - 0.5);
    tone += 0.10 * (noise(vec3(p * 170.0, 1.0)) - 0.5) * min(1.0, 0.003 / blur);
    return vec3(0.40, 0.375, 0.345) * tone * (1.0 - 0.35 * seam);
}

// Curtains: folds that bend the normal, and cloth.
vec3 curtain(vec3 p, int id, inout vec3 n) {
    float s = id < 3 ? p.y : p.x, phase = 42.0 * s + 1.3 * sin(5.1 * s + float(id)) + 0.8 * sin(11.0 * s);
    vec3 tangent = id < 3 ? vec3(0, 1, 0) : vec3(1, 0, 0);
    n = normalize(n - 0.85 * cos(phase) * tangent);
    float deep = 0.62 + 0.38 * sin(phase);
    return vec3(0.060, 0.072, 0.105) * deep * (0.92 + 0.16 * noise(vec3(s * 160.0, p.z * 60.0, 0.0)));
}

vec3 plain_colour(int material, vec3 rgb, vec3 q) {
    if (material == 1) {
        float ring = noise(vec3(q.x * 2.5, q.y * 34.0 + 2.0 * noise(vec3(q.xy * 3.0, 5.0)), q.z * 34.0));
        float pore = noise(vec3(q.x * 14.0, q.y * 300.0, q.z * 300.0));
        return rgb * (0.80 + 0.32 * ring - 0.10 * pore);
    }
    if (material == 4) return rgb * (0.85 + 0.3 * noise(q * 220.0));
    if (material == 5) return rgb * (0.96 + 0.08 * noise(q * 30.0));
    return rgb * (0.97 + 0.06 * noise(q * 60.0));
}

vec3 solid_colour(int index, vec3 p) {
    vec4 c = solid_texel(index, 4);
    vec3 q = p - solid_texel(index, 0).xyz;
    if (solid_texel(index, 0).w < 2.5) {
        mat3 axes = mat3(solid_texel(index, 1).xyz, solid_texel(index, 2).xyz, solid_texel(index, 3).xyz);
        q = q * axes;
    }
    return plain_colour(int(c.w + 0.5), c.rgb, q);
}
"""

_SHADE = """
vec3 shade(vec2 px, vec3 d, float t, int id, vec3 n) {
    vec3 p = eye + t * d, base, bent = n;
    float l = light_at(px, id, p, n);
    if (id == 5) base = floor_colour(p.xy, 1.2 * t * t / max(eye.z, 0.1) * per_px.x);
    else if (id == 6) base = vec3(0.72);
    else if (id < 5) {
        base = curtain(p, id, bent);
        l *= unblocked(p, bent) / unblocked(p, n);
    } else base = solid_colour(id - 1 - FACES, p);
    return display(base * l);
}
"""

_ROOM_PAINT = LENS + SOLID + LIGHT + PAINT + _SHADE

SHADE_MAIN = """
void main() {
    vec2 hit = texelFetch(seen, ivec2(gl_FragCoord.xy), 0).rg, px = gl_FragCoord.xy - 0.5;
    vec3 n = texelFetch(surface, ivec2(gl_FragCoord.xy), 0).xyz;
    float lit = hit.y > 0.5 ? 1.0 : 0.0;
    colour = vec4(lit * shade(px, to_room * ray_of(ivec2(gl_FragCoord.xy)), hit.x, int(hit.y + 0.5), n), 1.0);
}
"""

# llvmpipe runs both sides of a branch and skips only what the depth test rejects: the few pixels that deserve more work
# are marked in a depth buffer, and the work is done in a pass of its own.
ROOM_EDGES = """#version 330
uniform sampler2D seen, surface;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(seen, 0) - 1;
    float me = texelFetch(seen, at, 0).g;
    vec3 n = texelFetch(surface, at, 0).xyz;
    bool edge = false;
    for (int k = 0; k < 4; ++k) {
        ivec2 other = clamp(at + ivec2(int(k == 0) - int(k == 1), int(k == 2) - int(k == 3)), ivec2(0), most);
        edge = edge || texelFetch(seen, other, 0).g != me || dot(texelFetch(surface, other, 0).xyz, n) < 0.95;
    }
    if (!edge || me < 0.5) discard;   // where the lens images nothing, nothing is to be smoothed
    gl_FragDepth = 0.0;
}
"""

SMOOTH_MAIN = """
uniform int samples;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(seen, 0) - 1;
    colour = vec4(0.0, 0.0, 0.0, 1.0);
    for (int s = 0; s < samples; ++s) {
        vec2 px = gl_FragCoord.xy - 1.0 + fract(vec2(0.7548776662, 0.5698402910) * float(s + 1));
        vec3 ray = ray_through(px), d = to_room * ray, normal;
        int id;
        float nearest = hit_room(eye, d, id);
        vec3 m = face_normal(id);
        for (int k = 0; k < 5; ++k) {
            ivec2 other = clamp(at + ivec2(int(k == 1) - int(k == 2), int(k == 3) - int(k == 4)), ivec2(0), most);
            int solid = int(texelFetch(seen, other, 0).g + 0.5) - 1 - FACES;
            float t = hit_solid(eye, d, max(solid, 0), normal);
            if (solid >= 0 && t > 0.0 && t < nearest) { nearest = t; id = solid + 1 + FACES; m = normal; }
        }
        float lit = ray == vec3(0.0) || texelFetch(seen, at, 0).g < 0.5 ? 0.0 : 1.0 / float(samples);
        colour.rgb += lit * shade(px, d, nearest, id, m);
    }
}
"""

ROOM_SHADE, ROOM_SMOOTH = _ROOM_PAINT + SHADE_MAIN, _ROOM_PAINT + SMOOTH_MAIN
