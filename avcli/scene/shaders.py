"""The renderer's shaders (GLSL 3.30). Everything is in the camera's frame, metres; image row 0 is gl row 0."""

LENS = """#version 330
uniform vec2 centre, per_px, stretch;   // principal point, px to the lens's plane, and back to slopes (division)
uniform vec4 domain;                    // 1 / m_top^2, whether the variable is sqrt(1 - .), m_max^2, source bound
uniform float across[13], ahead[13];    // polynomials of the lateral and the axial part of the ray

// The unit ray through image point px, or (0, 0, 0) where the lens images nothing.
vec3 ray_through(vec2 px) {
    vec2 m = (px - centre) * per_px;
    float square = dot(m, m);
    float w = square * domain.x;
    if (domain.y > 0.5) w = sqrt(max(1.0 - w, 0.0));
    float a = across[12], b = ahead[12];
    for (int i = 11; i >= 0; --i) { a = a * w + across[i]; b = b * w + ahead[i]; }
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

PEOPLE_VERTEX = (
    CORNER
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
flat in vec4 fa, fb, fbulge, fmiddle;
uniform float pitch;
flat in vec2 fplace;   // from tile to image, in image pixels
out float covered;
void main() {
    vec3 d = ray_through((gl_FragCoord.xy - 0.5) * pitch + fplace);
    if (d == vec3(0.0) || hit_cone(d, fa, fb, fbulge, fmiddle.xyz) <= 0.0) discard;
    covered = 1.0;
}
"""
)

SHAPE_VERTEX = (
    CORNER
    + """
in vec4 ball_a, ball_b, bulge, middle;
in vec2 place;
flat out vec4 fa, fb, fbulge, fmiddle;
flat out vec2 fplace;
void main() { gl_Position = corner(); fa = ball_a; fb = ball_b; fbulge = bulge; fmiddle = middle; fplace = place; }
"""
)

RESOLVE_VERTEX = (
    CORNER
    + """
void main() { gl_Position = corner(); }
"""
)

ROOM_VERTEX = """#version 330
in vec4 rectangle;
in float solid;
uniform vec2 origin, size;   // of the tile: image pixel edges of its corner, and its extent in them
flat out int index;
void main() {
    vec2 at = mix(rectangle.xy, rectangle.zw, vec2(gl_VertexID & 1, gl_VertexID >> 1));
    gl_Position = vec4((at - origin) / size * 2.0 - 1.0, 0.0, 1.0);
    index = int(solid);
}
"""

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
uniform vec2 corner;       // image px of the tile's first sample
uniform float pitch;       // image px from sample to sample
layout(location = 0) out vec2 seen;
layout(location = 1) out vec4 surface;
void main() {
    vec3 ray = ray_through(corner + (gl_FragCoord.xy - 0.5) * pitch);
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

NOISE = """
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
vec3 display(vec3 light) {
    light = light / (1.0 + 0.22 * light);
    return pow(clamp(light, 0.0, 1.0), vec3(1.0 / 2.2));
}
"""

ROOM_SHADE = (
    LENS
    + SOLID
    + NOISE
    + """
uniform sampler2D seen, surface;
out vec4 colour;

vec3 floor_colour(vec2 p) {
    vec2 cell = floor(p / 0.6), edge = abs(fract(p / 0.6) - 0.5) * 0.6;
    float seam = smoothstep(0.296, 0.2985, max(edge.x, edge.y));
    float tone = 0.94 + 0.05 * hash(vec3(cell, 3.0)) + 0.05 * noise(vec3(p * 9.0, 0.0));
    tone -= 0.05 * noise(vec3(p * 260.0, 1.0));
    return vec3(0.43, 0.405, 0.375) * tone * (1.0 - 0.3 * seam);
}

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec2 hit = texelFetch(seen, at, 0).rg;
    if (hit.y < 0.5) { colour = vec4(0.0, 0.0, 0.0, 1.0); return; }
    vec3 d = to_room * ray_through(gl_FragCoord.xy - 0.5);
    vec3 p = eye + hit.x * d, n = texelFetch(surface, at, 0).xyz, base;
    int id = int(hit.y + 0.5);
    if (id == 5) base = floor_colour(p.xy);
    else if (id == 6) base = vec3(0.75);
    else if (id < 5) {
        float s = id < 3 ? p.y : p.x;
        float fold = sin(s * 40.0 + 2.0 * sin(s * 7.0)) ;
        base = vec3(0.055, 0.068, 0.10) * (0.75 + 0.45 * fold) * (0.9 + 0.2 * noise(vec3(s * 300.0, p.z * 300.0, 0.0)));
    } else base = solid_texel(id - 7, 4).rgb;
    float light = 0.45 + 0.55 * max(n.z, 0.0) + 0.15 * abs(n.x);
    colour = vec4(display(base * light * 1.3), 1.0);
}
"""
)

RESOLVE = (
    LENS
    + CONE
    + NOISE
    + """
uniform sampler2D seen, room_seen, room_colour, cones;
uniform mat3 to_room;
uniform float per_step;
uniform int samples;
layout(location = 0) out vec4 colour;
layout(location = 1) out uint depth;
layout(location = 2) out float id;

vec4 cone_texel(int index, int part) { return texelFetch(cones, ivec2(part, index), 0); }

// Distance of p to a cone, its outward gradient, and how far along its axis p lies.
float cone_distance(vec3 p, int index, out vec3 gradient, out float along) {
    vec4 a = cone_texel(index, 0), b = cone_texel(index, 1), bulge = cone_texel(index, 2);
    vec3 q = p + bulge.w * bulge.xyz * dot(bulge.xyz, p - cone_texel(index, 3).xyz) - a.xyz;
    vec3 axis = b.xyz - a.xyz;
    float length2 = max(dot(axis, axis), 1e-12), taper = a.w - b.w;
    float x = dot(q, axis) / length2, radial = length(q - x * axis);
    // The nearest ball of those that make up the cone: where the distance to the balls' surfaces is stationary.
    float slope = taper * inversesqrt(max(length2 - taper * taper, 1e-12));
    along = clamp(x - radial * slope * inversesqrt(length2), 0.0, 1.0);
    vec3 out_of = q - along * axis;
    float far = length(out_of);
    gradient = out_of / max(far, 1e-9);
    gradient = normalize(gradient + bulge.w * bulge.xyz * dot(bulge.xyz, gradient));
    return far - (a.w - along * taper);
}

vec3 shade(vec3 d, float t, int index) {
    vec3 p = t * d, normal, g;
    float along, other;
    cone_distance(p, index, normal, along);
    vec4 front = cone_texel(index, 6), base = cone_texel(index, 4), beyond = cone_texel(index, 5);
    int last = int(cone_texel(index, 7).x + 0.5);
    vec3 sum = normal;
    for (int j = int(front.w + 0.5); j < last; ++j) {
        if (j == index) continue;
        float apart = cone_distance(p, j, g, other);
        sum += exp(-max(apart, 0.0) / 0.016) * g;
    }
    normal = normalize(to_room * sum);
    vec3 albedo = along > beyond.w ? beyond.rgb : base.rgb;
    float light = 0.36 + 0.5 * max(normal.z, 0.0) + 0.25 * max(dot(normal, normalize(vec3(0.5, 0.35, 0.8))), 0.0);
    return display(albedo * light * 1.45);
}

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    vec2 hit = texelFetch(seen, at, 0).rg;
    float t = hit.y > 0.5 ? hit.x : texelFetch(room_seen, at, 0).r;
    float steps = floor(t * per_step + 0.5);
    depth = steps < 65535.5 ? uint(steps) : 0u;
    id = 0.0;
    vec4 room = texelFetch(room_colour, at, 0);
    if (hit.y > 0.5) {
        int index = int(hit.y - 0.5);
        id = cone_texel(index, 3).w / 255.0;
    }
    int found[9];
    int count = 0;
    bool edge = false;
    for (int k = 0; k < 9; ++k) {
        int other = int(texelFetch(seen, at + ivec2(k % 3 - 1, k / 3 - 1), 0).g + 0.5);
        edge = edge || other != int(hit.y + 0.5);
        bool known = other == 0;
        for (int j = 0; j < count; ++j) known = known || found[j] == other;
        if (!known) found[count++] = other;
    }
    if (count == 0) { colour = room; return; }
    if (!edge || samples < 2) {
        colour = hit.y > 0.5 ? vec4(shade(ray_through(gl_FragCoord.xy - 0.5), t, int(hit.y - 0.5)), 1.0) : room;
        return;
    }
    vec3 total = vec3(0.0);
    float limit = texelFetch(room_seen, at, 0).r;
    for (int s = 0; s < samples; ++s) {
        vec2 offset = fract(vec2(0.7548776662, 0.5698402910) * float(s + 1) + 0.5) - 0.5;
        vec3 d = ray_through(gl_FragCoord.xy - 0.5 + offset);
        float nearest = limit > 0.0 ? limit : 1e9;
        int which = -1;
        for (int j = 0; j < count; ++j) {
            int index = found[j] - 1;
            vec4 a = cone_texel(index, 0), b = cone_texel(index, 1), bulge = cone_texel(index, 2);
            float reach = hit_cone(d, a, b, bulge, cone_texel(index, 3).xyz);
            if (reach > 0.0 && reach < nearest) { nearest = reach; which = index; }
        }
        total += which < 0 ? room.rgb : shade(d, nearest, which);
    }
    colour = vec4(total / float(samples), 1.0);
}
"""
)
