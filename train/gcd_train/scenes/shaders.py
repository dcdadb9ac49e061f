"""The GLSL programs of the renderer: the shadow map, and the picture with depth and labels.

Software OpenGL works out every branch for every pixel, so each way of painting gets a program of its own, and matt
surfaces go without highlights and reflections (`fragment`).
"""

from gcd_train.scenes.description import DOMES, Pattern
from gcd_train.scenes.paints import PAINTS

_VERTEX_IN = """
#version 330
uniform sampler2D bodies;  // row b: the three rows of world_from_body of body b
in vec3 position;
vec3 placed(vec4 point, uint body) {
    vec4 x = texelFetch(bodies, ivec2(0, int(body)), 0);
    vec4 y = texelFetch(bodies, ivec2(1, int(body)), 0);
    vec4 z = texelFetch(bodies, ivec2(2, int(body)), 0);
    return vec3(dot(x, point), dot(y, point), dot(z, point));
}
"""

SHADELESS = (Pattern.SKY, *DOMES)
"""What casts no shadow."""
_NO_SHADOW = " || ".join(f"tags.w == {int(pattern)}u" for pattern in SHADELESS)

SHADOW_VERTEX = (
    _VERTEX_IN
    + """
in uvec4 tags;
uniform mat4 clip_from_world;
void main() {
    gl_Position = clip_from_world * vec4(placed(vec4(position, 1.0), tags.z), 1.0);
    if (NO_SHADOW) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // the sky casts no shadow
}
""".replace("NO_SHADOW", _NO_SHADOW)
)
SHADOW_FRAGMENT = """
#version 330
void main() {}
"""

_FRAME = """
layout(std140) uniform Frame {  // as `renderer._Frame` writes it
    mat4 clip_from_world, light_from_world;
    vec4 eye_, ahead_, sun_to_, sun_, sky_, ground_, horizon_, zenith_;
    float fog_m, cloud, exposure, shadow_lift;
};
"""

VERTEX = (
    _VERTEX_IN
    + _FRAME
    + """
in vec3 normal;
in vec4 colour, accent;
in uvec4 tags;
out vec3 local, normal_local, world, normal_world, in_light;
out float depth;
flat out vec4 paint, second;
flat out vec3 base_colour, second_colour;
flat out uvec4 labels;
void main() {
    world = placed(vec4(position, 1.0), tags.z);
    normal_world = placed(vec4(normal, 0.0), tags.z);
    local = position;
    normal_local = normal;
    in_light = (light_from_world * vec4(world + shadow_lift * normal_world, 1.0)).xyz * 0.5 + 0.5;
    depth = dot(world - eye_.xyz, ahead_.xyz);
    paint = colour;
    second = accent;
    base_colour = pow(colour.rgb, vec3(2.2));
    second_colour = pow(accent.rgb, vec3(2.2));
    labels = tags;
    gl_Position = clip_from_world * vec4(world, 1.0);
}
"""
)

_FRAGMENT_IN = """
uniform sampler2DShadow shadow;
in vec3 local, normal_local, world, normal_world, in_light;
in float depth;
flat in vec4 paint, second;
flat in vec3 base_colour, second_colour;
flat in uvec4 labels;
layout(location = 0) out vec4 rgb;
layout(location = 1) out vec2 facts;  // depth; class + 256 * instance + 65536 * body
#define eye eye_.xyz
#define sun_to sun_to_.xyz
#define sun sun_.xyz
#define sky sky_.xyz
#define ground ground_.xyz
#define horizon horizon_.xyz
#define zenith zenith_.xyz

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
vec3 seen(vec3 light) { return pow(1.0 - exp(-exposure * light), vec3(1.0 / 2.2)); }
"""

_SKY_MAIN = """
void main() {
    rgb = vec4(seen(sky_colour(normalize(world - eye))), 1.0);
    facts = vec2(0.0, float(labels.x + 256u * labels.y + 65536u * labels.z));
}
"""

_DOME_MAIN = """
void main() {
    rgb = vec4(seen(backdrop(normalize(world))), 1.0);
    facts = vec2(depth, float(labels.x + 256u * labels.y + 65536u * labels.z));
}
"""

_MAIN = """
float lit() {
    if (any(lessThan(in_light, vec3(0.0))) || any(greaterThan(in_light, vec3(1.0)))) return 1.0;
    return texture(shadow, vec3(in_light.xy, in_light.z - 0.0012));  // filtered over 2 x 2 by the sampler
}
void main() {
    vec3 ray = normalize(world - eye);
    float gloss;
    vec3 base = painted(base_colour, gloss);
    vec3 n = normalize(normal_world);
    float facing = max(dot(n, sun_to), 0.0);
    float in_sun = facing > 0.0 ? lit() : 0.0;
    vec3 light = sun * facing * in_sun + mix(ground, sky, 0.5 + 0.5 * n.z);
    vec3 colour = base * light;
#ifdef GLOSSY
    vec3 half_way = normalize(sun_to - ray);
    colour += gloss * in_sun * sun * 0.5 * pow(max(dot(n, half_way), 0.0), 30.0);
    colour += gloss * 0.25 * mirrored(reflect(ray, n)) * pow(1.0 - max(dot(-ray, n), 0.0), 2.0);
#endif
#ifdef LIT
    colour = base * 2.5;
#endif
    float far = distance(world, eye) / fog_m;
    colour = mix(colour, horizon, 1.0 - exp2(-far * far));
    rgb = vec4(seen(colour), 1.0);
    facts = vec2(depth, float(labels.x + 256u * labels.y + 65536u * labels.z));
}
"""

_OWN_MAIN = {Pattern.SKY: _SKY_MAIN, **dict.fromkeys(DOMES, _DOME_MAIN)}


def fragment(pattern: Pattern, *, glossy: bool) -> str:
    """The fragment shader that paints one pattern, with highlights and reflections or without."""
    defines = [f"#define {name}" for name, on in (("GLOSSY", glossy), ("LIT", pattern is Pattern.LIT)) if on]
    head = "\n".join(["#version 330", *defines])
    return head + _FRAME + _FRAGMENT_IN + PAINTS[pattern] + _OWN_MAIN.get(pattern, _MAIN)
