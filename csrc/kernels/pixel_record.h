// A pixel of the pixel database, packed into three 32-bit words.
//
// u | v << 16; the bits of the float32 depth (m); r | g << 8 | b << 16 | c << 24, where c is 128 times the
// foreshortening n . d of the surface normal n and the ray direction d with camera z = 1, 0 where unknown.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "spslam/types/camera.h"
#include "spslam/types/luma.h"

namespace spslam {

constexpr int kPixelWords = 3;
constexpr float kForeshorteningStep = 1.0f / 128.0f;
// Grazing surfaces: below this the normal is too uncertain to scale a distance by.
constexpr float kMinForeshortening = 0.15f;

struct Pixel {
  float u, v;            // px
  float depth;           // m, 0 where invalid
  float color[3];        // in [0, 1]
  float foreshortening;  // 1 where unknown
};

SPS_INLINE Pixel unpack_pixel(const std::int32_t* words) {
  const std::uint32_t uv = static_cast<std::uint32_t>(words[0]), rgbc = static_cast<std::uint32_t>(words[2]);
  Pixel pixel;
  pixel.u = static_cast<float>(uv & 0xFFFFu);
  pixel.v = static_cast<float>(uv >> 16);
  __builtin_memcpy(&pixel.depth, words + 1, sizeof(float));
  for (int k = 0; k < 3; ++k) pixel.color[k] = static_cast<float>((rgbc >> (8 * k)) & 0xFFu) * (1.0f / 255.0f);
  const float c = static_cast<float>(rgbc >> 24) * kForeshorteningStep;
  pixel.foreshortening = c == 0.0f ? 1.0f : (c < kMinForeshortening ? kMinForeshortening : c);
  return pixel;
}

// The record of a pixel of that depth, color [3] and surface normal [3] (0 = unknown) seen by a camera. The
// foreshortening is computed in double, so that rounding to a step does not depend on the order of operations.
SPS_INLINE void pack_pixel(std::int32_t u, std::int32_t v, float depth, const std::uint8_t* color, const float* normal,
                           double fx, double fy, double cx, double cy, std::int32_t* words) {
  const double facing = normal[0] * ((u - cx) / fx) + normal[1] * ((v - cy) / fy) + normal[2];
  const double steps = std::rint(std::fabs(facing) * (1.0 / kForeshorteningStep));
  const std::uint32_t c = static_cast<std::uint32_t>(steps < 255.0 ? steps : 255.0);
  words[0] = static_cast<std::int32_t>(static_cast<std::uint32_t>(u) | static_cast<std::uint32_t>(v) << 16);
  __builtin_memcpy(words + 1, &depth, sizeof(float));
  words[2] = static_cast<std::int32_t>(color[0] | color[1] << 8 | color[2] << 16 | c << 24);
}

// Intensity of a color in [0, 1].
SPS_INLINE float luma(const float* color) {
  constexpr float kRed = kLumaWeights[0] / 1000.0f, kGreen = kLumaWeights[1] / 1000.0f,
                  kBlue = kLumaWeights[2] / 1000.0f;
  return kRed * color[0] + kGreen * color[1] + kBlue * color[2];
}

// The same of a color of 8 bits per channel.
SPS_INLINE std::uint8_t rounded_luma(const std::uint8_t* color) {
  constexpr std::uint32_t kRed = kLumaWeights[0], kGreen = kLumaWeights[1], kBlue = kLumaWeights[2];
  return static_cast<std::uint8_t>((kRed * color[0] + kGreen * color[1] + kBlue * color[2] + 500) / 1000);
}

// Direction of a pixel's ray in camera axes, with z = 1: a point on it is depth times direction.
SPS_INLINE Vec3<float> pixel_ray(const Pixel& pixel, const Intrinsics& k) {
  return {(pixel.u - k.cx) / k.fx, (pixel.v - k.cy) / k.fy, 1.0f};
}

}  // namespace spslam
