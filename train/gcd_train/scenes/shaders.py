"""The two GLSL programs of the renderer: the shadow map, and the picture with depth and labels."""

_VERTEX_IN = """
#version 330
uniform sampler2D bodies;  // row b: the three rows of world_from_body of body b
uniform mat4 clip_from_world;
in vec3 position;
vec3 placed(vec4 point, uint body) {
    vec4 x = texelFetch(bodies, ivec2(0, int(body)), 0);
    vec4 y = texelFetch(bodies, ivec2(1, int(body)), 0);
    vec4 z = texelFetch(bodies, ivec2(2, int(body)), 0);
    return vec3(dot(x, point), dot(y, point), dot(z, point));
}
"""

SHADOW_VERTEX = (
    _VERTEX_IN
    + """
in uvec4 tags;
void main() {
    gl_Position = clip_from_world * vec4(placed(vec4(position, 1.0), tags.z), 1.0);
    if (tags.w == 4u) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // the sky casts no shadow
}
"""
)
SHADOW_FRAGMENT = """
#version 330
void main() {}
"""

VERTEX = (
    _VERTEX_IN
    + """
in vec3 normal;
in vec4 colour;
in uvec4 tags;
uniform mat4 light_from_world;
uniform vec3 eye;
uniform vec3 ahead;
out vec3 local, normal_local, world, normal_world, in_light;
out vec4 paint;
out float depth;
flat out uvec4 labels;
void main() {
    world = placed(vec4(position, 1.0), tags.z);
    normal_world = placed(vec4(normal, 0.0), tags.z);
    local = position;
    normal_local = normal;
    in_light = (light_from_world * vec4(world + 0.06 * normal_world, 1.0)).xyz * 0.5 + 0.5;
    depth = dot(world - eye, ahead);
    paint = colour;
    labels = tags;
    gl_Position = clip_from_world * vec4(world, 1.0);
}
"""
)

FRAGMENT = """
#version 330
uniform sampler2DShadow shadow;
uniform vec3 eye, sun_to, sun, sky, ground, horizon, zenith;
uniform float fog_m, cloud, exposure;
in vec3 local, normal_local, world, normal_world, in_light;
in vec4 paint;
in float depth;
flat in uvec4 labels;
layout(location = 0) out vec4 rgb;
layout(location = 1) out vec2 facts;  // depth; class + 256 * instance

float hash(vec2 p) { return fract(61.7 * fract(dot(p, vec2(0.7543, 0.5698)) + 0.137 * p.x * p.y)); }
float noise(vec2 p) {
    vec2 i = floor(p), f = fract(p);
    f = f * f * (3.0 - 2.0 * f);
    return mix(mix(hash(i), hash(i + vec2(1, 0)), f.x), mix(hash(i + vec2(0, 1)), hash(i + vec2(1, 1)), f.x), f.y);
}
vec3 sky_colour(vec3 ray) {
    float up = clamp(ray.z, 0.0, 1.0);
    vec3 clear = mix(horizon, zenith, pow(up, 0.55));
    vec2 at = ray.xy / (up + 0.15);
    float puff = smoothstep(0.45, 0.8, noise(at * 1.6) * 0.7 + noise(at * 4.0) * 0.3);
    return mix(clear, vec3(0.85), cloud * puff * smoothstep(0.02, 0.2, up));
}
float lit() {
    if (any(lessThan(in_light, vec3(0.0))) || any(greaterThan(in_light, vec3(1.0)))) return 1.0;
    return texture(shadow, vec3(in_light.xy, in_light.z - 0.0012));  // filtered over 2 x 2 by the sampler
}
vec3 painted(vec3 base, out float gloss) {
    gloss = paint.a;
    vec3 n = normalize(normal_local);
    vec2 wall = abs(n.z) < 0.5 ? vec2(dot(local.xy, normalize(vec2(-n.y, n.x) + 1e-5)), local.z) : local.xy;
    uint pattern = labels.w;
    if (pattern == 1u && abs(n.z) < 0.5) {  // windows: spacing and size follow from the wall's colour
        float wide = 2.2 + 2.0 * fract(paint.r * 37.0), high = 2.9 + 0.6 * fract(paint.g * 53.0);
        vec2 cell = fract(vec2(wall.x / wide, wall.y / high));
        vec2 share = vec2(0.35 + 0.45 * fract(paint.b * 71.0), 0.5);
        vec2 off = abs(cell - vec2(0.5, 0.55));
        if (off.x < share.x * 0.5 && off.y < share.y * 0.5 && wall.y > 0.6) {
            gloss = 0.6;
            return mix(vec3(0.03, 0.04, 0.06), sky * 0.35, 0.4 * hash(floor(vec2(wall.x / wide, wall.y / high))));
        }
        return base * (0.94 + 0.06 * step(0.06, fract(wall.y / high)));
    }
    if (pattern == 2u) return base * (0.86 + 0.2 * noise(wall * 1.7) + 0.1 * noise(wall * 0.31));
    if (pattern == 3u) {
        vec2 cell = fract(wall / 1.2);
        float seam = step(0.05, cell.x) * step(0.05, cell.y);
        return base * (0.82 + 0.12 * seam + 0.1 * hash(floor(wall / 1.2)));
    }
    if (pattern == 5u) return base * (0.6 + 0.75 * noise(wall * 2.3 + n.xy * 3.0));
    if (pattern == 6u) {
        float row = floor(wall.y / 0.6);
        vec2 cell = fract(vec2(wall.x / 1.4 + 0.5 * mod(row, 2.0), wall.y / 0.6));
        return base * (0.85 + 0.15 * step(0.12, cell.y) * step(0.06, cell.x));
    }
    return base;
}
void main() {
    vec3 ray = normalize(world - eye);
    float label = float(labels.x + 256u * labels.y);
    if (labels.w == 4u) {
        rgb = vec4(pow(1.0 - exp(-exposure * sky_colour(ray)), vec3(1.0 / 2.2)), 1.0);
        facts = vec2(0.0, label);
        return;
    }
    float gloss;
    vec3 base = painted(pow(paint.rgb, vec3(2.2)), gloss);
    vec3 n = normalize(normal_world);
    float facing = max(dot(n, sun_to), 0.0);
    float in_sun = facing > 0.0 ? lit() : 0.0;
    vec3 half_way = normalize(sun_to - ray);
    vec3 light = sun * facing * in_sun + mix(ground, sky, 0.5 + 0.5 * n.z);
    vec3 colour = base * light + gloss * in_sun * sun * 0.5 * pow(max(dot(n, half_way), 0.0), 30.0);
    colour += gloss * 0.25 * sky_colour(reflect(ray, n)) * pow(1.0 - max(dot(-ray, n), 0.0), 2.0);
    if (labels.w == 7u) colour = base * 2.5;
    float far = distance(world, eye) / fog_m;
    colour = mix(colour, horizon, 1.0 - exp2(-far * far));
    rgb = vec4(pow(1.0 - exp(-exposure * colour), vec3(1.0 / 2.2)), 1.0);
    facts = vec2(depth, label);
}
"""
