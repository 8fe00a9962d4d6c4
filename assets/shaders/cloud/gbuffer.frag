#version 450
// Fragment stage of the `cloud` shader pack: what a depth camera gives, and nothing else.
//
// No scene light is evaluated: the lighting code is what makes the stock packs slow to compile. The colour is the base
// colour under a lamp at the camera. Positions are integers in micrometres, because the renderer blends float outputs
// with the alpha channel, where the segmentation id is to stand.

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding1;
  vec4 textureTransforms[6];
} materialBuffer;

layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 2) uniform sampler2D roughnessTexture;
layout(set = 2, binding = 3) uniform sampler2D normalTexture;
layout(set = 2, binding = 4) uniform sampler2D metallicTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;

// The renderer looks these buffers up by name, so they are declared although no light is evaluated.
struct PointLight {
  vec4 position;
  vec4 emission;
};

struct DirectionalLight {
  vec4 direction;
  vec4 emission;
};

struct SpotLight {
  vec4 position;
  vec4 direction;
  vec4 emission;
};

layout(set = 3, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  DirectionalLight directionalLights[3];
  SpotLight spotLights[10];
  PointLight pointLights[10];
  SpotLight texturedLights[1];
} sceneBuffer;

layout(location = 0) in vec4 inPosition;
layout(location = 1) in vec2 inUV;
layout(location = 2) in flat uvec4 inSegmentation;

layout(location = 0) out vec4 outColor;
layout(location = 1) out ivec4 outCloudPosition;

const float MICROMETRES = 1e6;
const float AMBIENT = 0.35;

void main() {
  vec4 albedo = materialBuffer.baseColor;
  if ((materialBuffer.textureMask & 1) != 0) {
    vec4 t = materialBuffer.textureTransforms[0];
    albedo = texture(colorTexture, inUV * t.zw + t.xy);
  }
  albedo.a *= 1.0 - objectDataBuffer.transparency;
  if (albedo.a == 0.0) {
    discard;
  }
  vec3 normal = normalize(cross(dFdx(inPosition.xyz), dFdy(inPosition.xyz)));
  float facing = abs(dot(normal, normalize(inPosition.xyz)));
  vec3 color = albedo.rgb * (AMBIENT + (1.0 - AMBIENT) * facing);
  outColor = vec4(pow(clamp(color, vec3(0), vec3(1)), vec3(1.0 / 2.2)), 1.0);
  outCloudPosition = ivec4(ivec3(round(inPosition.xyz * MICROMETRES)), inSegmentation[1]);
}
