"""The renderer's shaders (GLSL 3.30). Everything is in the camera's frame, metres; image row 0 is gl row 0."""

LENS = """#version 330
uniform vec2 centre, per_px, stretch;   // principal point, px to the lens's plane, and back to slopes (division)
uniform vec4 domain;                    // 1 / m_top^2, whether the variable is sqrt(1 - .), m_max^2, source bound
uniform vec2 series[TERMS];             // Chebyshev coefficients of the lateral and the axial part of the ray

// The unit ray through image point px, or (0, 0, 0) where the lens images nothing.
vec3 ray_through(vec2 px) {
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
    if (square > domain.z || (domain.w > 0.5 && max(abs(lateral.x), abs(lateral.y)) > 1.0)) return vec3(0.0);
    return normalize(vec3(lateral * stretch, b));
}
"""

CONE = """
// Distance along the unit ray d from the origin to a rounded cone, negative where it is missed. (a, ra) and (b, rb) are
// its balls in the space in which it is not flattened: x + bulge.w n (n.(x - middle)), n = bulge.xyz.
float hit_cone(vec3 d, vec4 ball_a, vec4 ball_b, vec4 bulge, vec3 middle) {
    vec3 shift = -bulge.w * dot(bulge.xyz, middle) * bulge.xyz;
    vec3 dir = d + bulge.w * dot(bulge.xyz, d) * bulge.xyz;
    float speed = length(dir);
    dir /= speed;
    // Start where the ray passes the cone's middle: the large numbers cancel before they are squared.
    float start = dot(0.5 * (ball_a.xyz + ball_b.xyz) - shift, dir);
    vec3 p = shift + start * dir - ball_a.xyz;
    vec3 axis = ball_b.xyz - ball_a.xyz;
    float ra = ball_a.w, rb = ball_b.w, taper = ra - rb;
    float aa = dot(axis, axis), ad = dot(axis, dir), ap = dot(axis, p), dp = dot(dir, p), pp = dot(p, p);
    float slant = aa - taper * taper;
    float t = 1e9;
    if (slant > 0.0) {
        float q2 = slant - ad * ad;
        float q1 = slant * dp - ap * ad + ad * taper * ra;
        float q0 = slant * pp - ap * ap + 2.0 * ap * taper * ra - aa * ra * ra;
        float h = q1 * q1 - q2 * q0;
        if (h < 0.0) return -1.0;
        float side = (-sqrt(h) - q1) / q2;
        float along = ap - ra * taper + side * ad;
        if (along > 0.0 && along < slant) return (start + side) / speed;
    }
    float ha = dp * dp - pp + ra * ra;
    if (ha > 0.0) t = -dp - sqrt(ha);
    vec3 e = p - axis;
    float de = dot(dir, e), hb = de * de - dot(e, e) + rb * rb;
    if (hb > 0.0) t = min(t, -de - sqrt(hb));
    return t < 1e8 ? (start + t) / speed : -1.0;
}
"""

CORNER = """#version 330
in vec4 rectangle;   // x0, y0, x1, y1 in pixel edges
uniform vec2 size;
vec4 corner() {
    vec2 at = mix(rectangle.xy, rectangle.zw, vec2(gl_VertexID & 1, gl_VertexID >> 1));
    return vec4(at / size * 2.0 - 1.0, 0.0, 1.0);
}
"""

QUAD = """#version 330
in vec2 origin;      // of a parallelogram of pixels, and its two edges
in vec4 edges;
uniform vec2 size;
vec4 corner() {
    vec2 at = origin + float(gl_VertexID & 1) * edges.xy + float(gl_VertexID >> 1) * edges.zw;
    return vec4(at / size * 2.0 - 1.0, 0.0, 1.0);
}
"""

PEOPLE_VERTEX = (
    QUAD
    + """
in vec4 ball_a, ball_b, bulge, middle;   // middle.w: index of the cone
flat out vec4 fa, fb, fbulge, fmiddle;
void main() { gl_Position = corner(); fa = ball_a; fb = ball_b; fbulge = bulge; fmiddle = middle; }
"""
)

# Which cone is seen, and how far: depth test between cones, comparison with the room by hand.
PEOPLE_FRAGMENT = (
    LENS
    + CONE
    + """
flat in vec4 fa, fb, fbulge, fmiddle;
uniform sampler2D room_depth;
out vec2 seen;
void main() {
    vec3 d = ray_through(gl_FragCoord.xy - 0.5);
    if (d == vec3(0.0)) discard;
    float t = hit_cone(d, fa, fb, fbulge, fmiddle.xyz);
    if (t <= 0.0) discard;
    float room = texelFetch(room_depth, ivec2(gl_FragCoord.xy), 0).r;
    if (room > 0.0 && t > room) discard;
    seen = vec2(t, fmiddle.w + 1.0);
    gl_FragDepth = clamp(t / 64.0, 0.0, 1.0);
}
"""
)

# The whole silhouette of each person in a tile of its own: nothing hides it, and the image has no border.
SHAPE_FRAGMENT = (
    LENS
    + CONE
    + """
flat in vec4 fa, fb, fbulge, fmiddle, ftile;
uniform float pitch;
flat in vec2 fplace;   // from tile to image, in image pixels
out float covered;
void main() {
    if (any(lessThan(gl_FragCoord.xy, ftile.xy)) || any(greaterThan(gl_FragCoord.xy, ftile.zw))) discard;
    vec3 d = ray_through((gl_FragCoord.xy - 0.5) * pitch + fplace);
    if (d == vec3(0.0) || hit_cone(d, fa, fb, fbulge, fmiddle.xyz) <= 0.0) discard;
    covered = 1.0;
}
"""
)

SHAPE_VERTEX = (
    QUAD
    + """
in vec4 ball_a, ball_b, bulge, middle, tile;
in vec2 place;
flat out vec4 fa, fb, fbulge, fmiddle, ftile;
flat out vec2 fplace;
void main() {
    gl_Position = corner();
    fa = ball_a; fb = ball_b; fbulge = bulge; fmiddle = middle; fplace = place; ftile = tile;
}
"""
)

FLAT_VERTEX = (
    CORNER
    + """
uniform float level;   // depth of the quad, against which marked pixels are tested
void main() { gl_Position = vec4(corner().xy, 2.0 * level - 1.0, 1.0); }
"""
)

ROOM_VERTEX = (
    CORNER
    + """
in float solid;
flat out int index;
void main() { gl_Position = corner(); index = int(solid); }
"""
)

# A solid is five texels: centre + kind, three axes (+ half sizes), colour + material.
SOLID = """
uniform sampler2D solids;
uniform mat3 to_room;        // camera frame to room
uniform vec3 eye, room;      // camera's place and the room's size, m
const int FACES = 6;

vec4 solid_texel(int index, int part) { return texelFetch(solids, ivec2(part, index), 0); }

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

ROOM_FRAGMENT = (
    LENS
    + SOLID
    + """
flat in int index;
layout(location = 0) out vec2 seen;
layout(location = 1) out vec4 surface;
void main() {
    vec3 ray = ray_through(gl_FragCoord.xy - 0.5);
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
    gl_FragDepth = clamp(t / 64.0, 0.0, 1.0);
}
"""
)

LIGHT = """
uniform vec3 lamps[2];       // middles of the ceiling lights, room frame
const float LAMP_RADIUS = 0.35;

float hash(vec3 p) {
    p = fract(p * vec3(0.1031, 0.1030, 0.0973));
    p += dot(p, p.yxz + 33.33);
    return fract((p.x + p.y) * p.z);
}
float noise(vec3 p) {
    vec3 i = floor(p), f = fract(p);
    f = f * f * (3.0 - 2.0 * f);
    vec3 x = vec3(1, 0, 0), y = vec3(0, 1, 0), k = i + vec3(0, 0, 1);
    vec4 low = vec4(hash(i), hash(i + x), hash(i + y), hash(i + x + y));
    vec4 high = vec4(hash(k), hash(k + x), hash(k + y), hash(k + x + y));
    vec4 mid = mix(low, high, f.z);
    return mix(mix(mid.x, mid.y, f.x), mix(mid.z, mid.w, f.x), f.y);
}
// Light from above and, bounced, from below.
float sky(vec3 n) { return 0.40 + 0.18 * n.z; }
float lamp(vec3 p, vec3 n, int k) {
    vec3 way = lamps[k] - p;
    float square = dot(way, way);
    return 2.7 * max(dot(n, way) * inversesqrt(square) + 0.08, 0.0) / (square + 1.5);
}
// Linear light to the picture: highlights roll off, gamma 2.
vec3 display(vec3 light) { return sqrt(clamp(light * (1.0 + 0.12 * light) / (1.0 + 0.62 * light), 0.0, 1.0)); }
"""

# How much light reaches the room's surfaces, on a coarse grid: lamps behind furniture, and the open sky above.
ROOM_LIGHT = (
    LENS
    + SOLID
    + LIGHT
    + """
uniform sampler2D seen, surface;
uniform int blockers, coarse;
out float light;

bool blocked(vec3 o, vec3 d, float far) {
    for (int k = 0; k < blockers; ++k) {
        vec4 c = solid_texel(k, 0), x = solid_texel(k, 1), y = solid_texel(k, 2), z = solid_texel(k, 3);
        vec3 reach = vec3(x.w, y.w, z.w), lo = o - c.xyz;
        // A ball around it is asked first.
        float along = dot(lo, d);
        if (dot(lo, lo) - along * along > dot(reach, reach)) continue;
        mat3 axes = mat3(x.xyz, y.xyz, z.xyz);
        lo = lo * axes;
        vec3 ld = d * axes;
        if (c.w > 1.5) {
            float h = along * along - dot(lo, lo) + reach.x * reach.x;
            if (h > 0.0 && -along - sqrt(h) > 1e-3 && -along - sqrt(h) < far) return true;
            continue;
        }
        ld = mix(ld, vec3(1e-20), lessThan(abs(ld), vec3(1e-20)));
        vec3 near3 = -lo / ld - abs(reach / ld), far3 = -lo / ld + abs(reach / ld);
        float enter = max(near3.x, max(near3.y, near3.z)), leave = min(far3.x, min(far3.y, far3.z));
        if (enter < leave && enter > 1e-3 && enter < far) return true;
    }
    return false;
}

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy) * coarse + coarse / 2;
    vec2 hit = texelFetch(seen, at, 0).rg;
    light = 0.0;
    if (hit.y < 0.5) return;
    vec3 n = texelFetch(surface, at, 0).xyz;
    vec3 p = eye + hit.x * (to_room * ray_through(vec2(at))) + 2e-3 * n;
    float turn = 6.2832 * hash(vec3(gl_FragCoord.xy, 1.0)), ring = hash(vec3(gl_FragCoord.yx, 2.0));
    for (int k = 0; k < 2; ++k) {
        float open = 0.0;
        for (int s = 0; s < 5; ++s) {
            float r = LAMP_RADIUS * sqrt((float(s) + ring) / 5.0), a = turn + 2.39996 * float(s);
            vec3 way = lamps[k] + r * vec3(cos(a), sin(a), 0.0) - p;
            float far = length(way);
            open += blocked(p, way / far, far) ? 0.0 : 0.2;
        }
        light += open * lamp(p, n, k);
    }
    vec3 u = normalize(cross(n, abs(n.z) < 0.9 ? vec3(0, 0, 1) : vec3(1, 0, 0))), v = cross(n, u);
    float open = 0.0;
    for (int s = 0; s < 8; ++s) {
        float r = sqrt((float(s) + ring) / 8.0), a = turn + 2.39996 * float(s);
        vec3 d = r * cos(a) * u + r * sin(a) * v + sqrt(1.0 - r * r) * n;
        open += blocked(p, d, 0.9) ? 0.0 : 0.125;
    }
    // Corners of the room see less of it.
    vec3 gap = min(p, room - p) + abs(n) * 9.0;
    float corner = 1.0 - 0.45 * exp(-3.0 * min(gap.x, min(gap.y, gap.z)));
    light += open * corner * sky(n);
}
"""
)

# Averages the coarse light over neighbours on the same surface.
ROOM_BLUR = """#version 330
uniform sampler2D seen, surface, light;
uniform int coarse;
out float smoothed;
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
    smoothed = sum / max(weights, 1.0);
}
"""

_ROOM_PAINT = (
    LENS
    + SOLID
    + LIGHT
    + """
uniform sampler2D seen, surface, light;
uniform int coarse;
out vec4 colour;

float light_at(vec2 px, int id, vec3 n) {
    vec2 at = (px + 0.5 - float(coarse / 2) - 0.5) / float(coarse);
    ivec2 base = ivec2(floor(at)), most = textureSize(light, 0) - 1;
    vec2 f = at - vec2(base);
    float sum = 0.0, weights = 0.0, any_sum = 0.0;
    for (int y = -1; y <= 2; ++y) for (int x = -1; x <= 2; ++x) {
        ivec2 other = clamp(base + ivec2(x, y), ivec2(0), most);
        ivec2 there = other * coarse + coarse / 2;
        vec2 near2 = max(1.0 - 0.6 * abs(vec2(x, y) - f), 0.02);
        float w = near2.x * near2.y, l = texelFetch(light, other, 0).r;
        any_sum += l / 16.0;
        int there_id = int(texelFetch(seen, there, 0).g + 0.5);
        w *= there_id == id && dot(texelFetch(surface, there, 0).xyz, n) > 0.9 ? 1.0 : 0.0;
        sum += w * l;
        weights += w;
    }
    return weights > 1e-4 ? sum / weights : any_sum;
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

vec3 solid_colour(int index, vec3 p) {
    vec4 c = solid_texel(index, 4);
    vec3 q = p - solid_texel(index, 0).xyz;
    if (solid_texel(index, 0).w < 2.5) {
        mat3 axes = mat3(solid_texel(index, 1).xyz, solid_texel(index, 2).xyz, solid_texel(index, 3).xyz);
        q = q * axes;
    }
    int material = int(c.w + 0.5);
    if (material == 1) {
        float ring = noise(vec3(q.x * 2.5, q.y * 34.0 + 2.0 * noise(vec3(q.xy * 3.0, 5.0)), q.z * 34.0));
        float pore = noise(vec3(q.x * 14.0, q.y * 300.0, q.z * 300.0));
        return c.rgb * (0.80 + 0.32 * ring - 0.10 * pore);
    }
    if (material == 4) return c.rgb * (0.85 + 0.3 * noise(q * 220.0));
    if (material == 5) return c.rgb * (0.96 + 0.08 * noise(q * 30.0));
    return c.rgb * (0.97 + 0.06 * noise(q * 60.0));
}

vec3 shade(vec2 px, vec3 d, float t, int id, vec3 n) {
    vec3 p = eye + t * d, base, bent = n;
    float l = light_at(px, id, n);
    if (id == 5) base = floor_colour(p.xy, 1.2 * t * t / max(eye.z, 0.1) * per_px.x);
    else if (id == 6) base = vec3(0.72);
    else if (id < 5) {
        base = curtain(p, id, bent);
        float plain = sky(n) + lamp(p, n, 0) + lamp(p, n, 1);
        l *= (sky(bent) + lamp(p, bent, 0) + lamp(p, bent, 1)) / plain;
    } else base = solid_colour(id - 1 - FACES, p);
    return display(base * l);
}
"""
)

ROOM_SHADE = (
    _ROOM_PAINT
    + """
void main() {
    vec2 hit = texelFetch(seen, ivec2(gl_FragCoord.xy), 0).rg, px = gl_FragCoord.xy - 0.5;
    vec3 n = texelFetch(surface, ivec2(gl_FragCoord.xy), 0).xyz;
    float lit = hit.y > 0.5 ? 1.0 : 0.0;
    colour = vec4(lit * shade(px, to_room * ray_through(px), hit.x, int(hit.y + 0.5), n), 1.0);
}
"""
)

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
    if (!edge) discard;
    gl_FragDepth = 0.0;
}
"""

ROOM_SMOOTH = (
    _ROOM_PAINT
    + """
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
)

SHADOW_VERTEX = (
    CORNER
    + """
in vec2 balls;       // first and end index of the person's balls
flat out ivec2 mine;
void main() { gl_Position = corner(); mine = ivec2(balls + 0.5); }
"""
)

# How much darker a person makes the room around their feet: a factor for the picture, on a coarse grid.
SHADOW_FRAGMENT = (
    LENS
    + LIGHT
    + """
flat in ivec2 mine;
uniform sampler2D seen, surface, balls;
uniform mat3 to_room;
uniform vec3 eye;
uniform int coarse;
out float factor;
void main() {
    ivec2 at = min(ivec2(gl_FragCoord.xy) * coarse + coarse / 2, textureSize(seen, 0) - 1);
    vec2 hit = texelFetch(seen, at, 0).rg;
    if (hit.y < 0.5) discard;
    vec3 p = eye + hit.x * (to_room * ray_through(vec2(at))), n = texelFetch(surface, at, 0).xyz;
    float open = 1.0;
    vec2 clear = vec2(1.0);
    vec3 ways[2];
    vec2 spread;
    for (int k = 0; k < 2; ++k) {
        ways[k] = lamps[k] - p;
        float far = length(ways[k]);
        ways[k] /= far;
        spread[k] = LAMP_RADIUS / far;
    }
    for (int j = mine.x; j < mine.y; ++j) {
        vec4 ball = texelFetch(balls, ivec2(j, 0), 0);
        vec3 way = ball.xyz - p;
        float square = max(dot(way, way), ball.w * ball.w), r2 = ball.w * ball.w;
        open *= 1.0 - 0.85 * max(dot(n, way), 0.0) * inversesqrt(square) * r2 / square;
        for (int k = 0; k < 2; ++k) {
            float along = dot(way, ways[k]);
            float aside = sqrt(max(square - along * along, 0.0)), soft = max(along, 0.0) * spread[k] + 0.02;
            float cover = 1.0 - smoothstep(ball.w - soft, ball.w + soft, aside);
            if (along > 0.0) clear[k] *= 1.0 - cover * min(1.0, r2 / (soft * soft));
        }
    }
    vec4 foot = texelFetch(balls, ivec2(mine.x + 3, 0), 0);
    float fade = smoothstep(0.65, 0.4, distance(foot.xy, p.xy));
    float all = sky(n) + lamp(p, n, 0) + lamp(p, n, 1);
    float left = open * sky(n) + clear.x * lamp(p, n, 0) + clear.y * lamp(p, n, 1);
    factor = mix(1.0, sqrt(left / all), fade);
}
"""
)

BASE = """#version 330
uniform sampler2D seen, room_seen, room_colour, shadow, cones, painted;
uniform float per_step;
layout(location = 0) out vec4 colour;
layout(location = 1) out uint depth;
layout(location = 2) out float id;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec2 hit = texelFetch(seen, at, 0).rg;
    bool person = hit.y > 0.5;
    float t = person ? hit.x : texelFetch(room_seen, at, 0).r;
    float steps = floor(t * per_step + 0.5);
    depth = steps < 65535.5 ? uint(steps) : 0u;
    id = person ? texelFetch(cones, ivec2(3, int(hit.y - 0.5)), 0).w / 255.0 : 0.0;
    float dark = texture(shadow, gl_FragCoord.xy / vec2(textureSize(seen, 0))).r;
    vec3 room = texelFetch(room_colour, at, 0).rgb * dark;
    colour = vec4(person ? texelFetch(painted, at, 0).rgb : room, 1.0);
}
"""

# Where nobody is or was, only the shadow on the room may have changed.
DIM = """#version 330
uniform sampler2D seen, room_colour, shadow;
out vec4 colour;
void main() {
    float dark = texture(shadow, gl_FragCoord.xy / vec2(textureSize(seen, 0))).r;
    colour = vec4(texelFetch(room_colour, ivec2(gl_FragCoord.xy), 0).rgb * dark, 1.0);
}
"""

_PAINT = (
    LENS
    + CONE
    + LIGHT
    + """
uniform sampler2D seen, cones, balls;
uniform mat3 to_room;
uniform vec3 eye;
out vec4 colour;

vec4 cone_texel(int index, int part) { return texelFetch(cones, ivec2(part, index), 0); }

// Distance of p to a cone, its outward gradient, how far along its axis p lies, and the place on its ball there.
float cone_distance(vec3 p, int index, out vec3 gradient, out float along, out vec3 place) {
    vec4 a = cone_texel(index, 0), b = cone_texel(index, 1), bulge = cone_texel(index, 2);
    vec3 q = p + bulge.w * bulge.xyz * dot(bulge.xyz, p - cone_texel(index, 3).xyz) - a.xyz;
    vec3 axis = b.xyz - a.xyz;
    float length2 = max(dot(axis, axis), 1e-12), taper = a.w - b.w;
    float x = dot(q, axis) / length2, radial = length(q - x * axis);
    // The nearest ball of those that make up the cone: where the distance to the balls' surfaces is stationary.
    float slope = taper * inversesqrt(max(length2 - taper * taper, 1e-12));
    along = clamp(x - radial * slope * inversesqrt(length2), 0.0, 1.0);
    place = q - along * axis;
    float far = length(place);
    gradient = place / max(far, 1e-9);
    gradient = normalize(gradient + bulge.w * bulge.xyz * dot(bulge.xyz, gradient));
    return far - (a.w - along * taper);
}

// For each material: the scales of its two textures, their strengths, how much they bend the surface, and the gloss.
const vec3 COARSE[8] = vec3[8](vec3(45), vec3(22, 22, 30), vec3(16, 16, 9), vec3(150, 150, 14), vec3(30),
                               vec3(22, 22, 30), vec3(22, 22, 30), vec3(30));
const vec3 FINE[8] = vec3[8](vec3(150), vec3(420), vec3(500, 500, 160), vec3(420, 420, 30), vec3(90), vec3(420),
                             vec3(420), vec3(90));
const vec4 GRAIN[8] = vec4[8](vec4(0.10, 0.04, 0.0, 0.035), vec4(0.24, 0.12, 0.20, 0.0), vec4(0.34, 0.25, 0.1, 0.0),
                              vec4(0.60, 0.45, 0.0, 0.10), vec4(0.1, 0.05, 0.0, 0.16), vec4(0.24, 0.12, 0.20, 0.0),
                              vec4(0.24, 0.12, 0.20, 0.0), vec4(0.0, 0.0, 0.0, 0.3));

vec3 shade(vec3 d, float t, int index) {
    vec3 p = t * d, normal, g, place, unused;
    float along, other;
    cone_distance(p, index, normal, along, place);
    vec4 base = cone_texel(index, 4), beyond = cone_texel(index, 5), front = cone_texel(index, 6);
    vec4 more = cone_texel(index, 7), touching = cone_texel(index, 8);
    vec3 sum = normal;
    for (int k = 0; k < 4; ++k) {
        int neighbour = int(touching[k] + 0.5);
        float apart = cone_distance(p, max(neighbour, 0), g, other, unused);
        sum += touching[k] < -0.5 ? vec3(0.0) : exp(-max(apart, 0.0) / 0.016) * g;
    }
    normal = normalize(sum);
    // Coordinates that move with the part: to its front, to its side, and along it.
    vec3 axis = cone_texel(index, 1).xyz - cone_texel(index, 0).xyz;
    float extent = length(axis);
    axis = extent > 1e-6 ? axis / extent : vec3(0.0, -1.0, 0.0);
    vec3 ahead = normalize(front.xyz - axis * dot(front.xyz, axis) + 1e-6), side = cross(axis, ahead);
    vec3 local = vec3(dot(place, ahead), dot(place, side), along * extent);
    float hem = 0.7 * t * per_px.x / max(extent, 1e-3), bare = smoothstep(-hem, hem, along - beyond.w);
    vec3 albedo = mix(base.rgb, beyond.rgb, bare);
    int material = bare > 0.5 ? 0 : int(base.w + 0.5);
    vec4 grain = GRAIN[material];
    float large = noise((local + front.w) * COARSE[material]) - 0.5;
    float small = noise((local + front.w) * FINE[material]) - 0.5;
    vec2 band = smoothstep(-0.2, 0.2, sin(vec2(local.z, 1.3 * local.y) * 125.0));
    float print = material == 5 ? smoothstep(-0.15, 0.15, sin(local.z * 209.0) - 0.35) : 0.0;
    print = material == 6 ? 0.30 * (band.x + band.y) : print;
    albedo = mix(albedo, more.rgb, print);
    float look = dot(normalize(place + 1e-9), normalize(front.xyz));
    vec3 iris = look > 0.93 ? vec3(0.01) : look > 0.80 ? vec3(0.12, 0.07, 0.035) : albedo;
    albedo = material == 7 ? iris : albedo;
    float sharp = min(1.0, 2.2e-3 / (t * per_px.x));
    albedo *= 1.0 + grain.x * large + grain.y * sharp * small;
    normal = normalize(normal + grain.z * large * (dot(normal, side) > 0.0 ? side : -side));
    vec3 n = to_room * normal, at = eye + to_room * p;
    float open = 1.0;
    int first = int(more.w + 0.5);
    for (int j = 0; j < 8; ++j) {
        vec4 ball = texelFetch(balls, ivec2(first + j, 0), 0);
        vec3 way = ball.xyz - at;
        float square = dot(way, way);
        open *= 1.0 - 0.8 * max(dot(n, way), 0.0) * inversesqrt(square) * min(ball.w * ball.w / square, 1.0);
    }
    float light = open * sky(n) * (0.75 + 0.25 * smoothstep(0.0, 0.9, at.z)), shine = 0.0;
    vec3 toward = -(to_room * d);
    for (int k = 0; k < 2; ++k) {
        light += (0.35 + 0.65 * open) * lamp(at, n, k);
        float glint = max(dot(n, normalize(normalize(lamps[k] - at) + toward)), 0.0);
        glint *= glint; glint *= glint; glint *= glint; glint *= glint;
        shine += glint * glint;
    }
    return display(albedo * light * 1.08 + grain.w * shine * 0.35);
}
"""
)

SHADE = (
    _PAINT
    + """
void main() {
    vec2 hit = texelFetch(seen, ivec2(gl_FragCoord.xy), 0).rg;
    colour = vec4(shade(ray_through(gl_FragCoord.xy - 0.5), hit.x, int(max(hit.y, 1.0) - 0.5)), 1.0);
}
"""
)

EDGES = """#version 330
uniform sampler2D seen;
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(seen, 0) - 1;
    float me = texelFetch(seen, at, 0).g;
    bool edge = texelFetch(seen, min(at + ivec2(1, 0), most), 0).g != me;
    edge = edge || texelFetch(seen, max(at - ivec2(1, 0), 0), 0).g != me;
    edge = edge || texelFetch(seen, min(at + ivec2(0, 1), most), 0).g != me;
    edge = edge || texelFetch(seen, max(at - ivec2(0, 1), 0), 0).g != me;
    if (!edge) discard;
    gl_FragDepth = 0.0;
}
"""

# An outline's pixel: how much of it each neighbour's cone covers, in the colour that the neighbour has.
SMOOTH = (
    LENS
    + CONE
    + """
uniform sampler2D seen, cones, room_seen, room_colour, shadow, painted;
uniform int samples;
out vec4 colour;
vec4 cone_texel(int index, int part) { return texelFetch(cones, ivec2(part, index), 0); }
void main() {
    ivec2 at = ivec2(gl_FragCoord.xy), most = textureSize(seen, 0) - 1;
    float room = texelFetch(room_seen, at, 0).r;
    float dark = texture(shadow, gl_FragCoord.xy / vec2(textureSize(seen, 0))).r;
    vec3 behind = texelFetch(room_colour, at, 0).rgb * dark, total = vec3(0.0);
    for (int s = 0; s < samples; ++s) {
        vec3 d = ray_through(gl_FragCoord.xy - 1.0 + fract(vec2(0.7548776662, 0.5698402910) * float(s + 1)));
        float nearest = room > 0.0 ? room : 1e9;
        ivec2 source = ivec2(-1);
        for (int k = 0; k < 5; ++k) {
            ivec2 other = clamp(at + ivec2(int(k == 1) - int(k == 2), int(k == 3) - int(k == 4)), ivec2(0), most);
            int index = int(texelFetch(seen, other, 0).g + 0.5) - 1, safe = max(index, 0);
            vec3 middle = cone_texel(safe, 3).xyz;
            float reach = hit_cone(d, cone_texel(safe, 0), cone_texel(safe, 1), cone_texel(safe, 2), middle);
            if (index >= 0 && reach > 0.0 && reach < nearest) { nearest = reach; source = other; }
        }
        total += source.x >= 0 ? texelFetch(painted, max(source, 0), 0).rgb : behind;
    }
    colour = vec4(room > 0.0 ? total / float(samples) : vec3(0.0), 1.0);
}
"""
)
