// The maths of one pixel of a depth image whose color another camera took.
#pragma once

#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "spslam/color_registration.h"

namespace spslam {

// Steps between two pixels of the color image. Sums of products with two such weights fit into 16 bits if kFirstShift
// bits are dropped in between.
constexpr int kColorSteps = 64, kFirstShift = 4, kSecondShift = 8;

// `z` is the depth from the color camera, m; u and v are left of and above the image behind it.
struct SeenPixel {
  float u, v, z;
};

// The part of a map that a row of pixels has in common.
struct PixelMapRow {
  float by_u[3], constant[3], offset[3];
};

SPS_INLINE PixelMapRow row_of_map(const PixelMap& map, float v) {
  PixelMapRow row{};
  for (int k = 0; k < 3; ++k) {
    row.by_u[k] = map.by_u[k];
    row.constant[k] = map.by_v[k] * v + map.constant[k];
    row.offset[k] = map.offset[k];
  }
  return row;
}

SPS_INLINE SeenPixel seen_pixel(const PixelMapRow& row, float u, float z) {
  constexpr float kOutside = -9.0f;
  const float w = z * (row.by_u[2] * u + row.constant[2]) + row.offset[2];
  const float share = 1.0f / w;
  const float x = (z * (row.by_u[0] * u + row.constant[0]) + row.offset[0]) * share;
  const float y = (z * (row.by_u[1] * u + row.constant[1]) + row.offset[1]) * share;
  return {w > 0.0f ? x : kOutside, w > 0.0f ? y : kOutside, w};
}

// Whether a point falls on a pixel of an image; not if it is NaN.
SPS_INLINE bool is_in_image(const SeenPixel& at, std::int32_t width, std::int32_t height) {
  return (at.u > -0.5f) & (at.v > -0.5f) & (at.u < static_cast<float>(width) - 0.5f) &
         (at.v < static_cast<float>(height) - 0.5f);
}

// A place between a pixel and the next one along an axis: the pixel, so that there is a next one if the axis has two,
// and the next one's weight in 1 / kColorSteps. Beyond the border that of the border.
struct ColorPlace {
  std::int32_t pixel, weight;
};

SPS_INLINE ColorPlace color_place(float at, std::int32_t size) {
  const float last = static_cast<float>(size - 1);
  const float inside = smaller(larger(at, 0.0f), last);  // NaN becomes 0
  const std::int32_t floor = static_cast<std::int32_t>(inside);
  const std::int32_t most = size > 1 ? size - 2 : 0;
  const std::int32_t pixel = floor < most ? floor : most;
  const float share = (inside - static_cast<float>(pixel)) * static_cast<float>(kColorSteps);
  return {pixel, static_cast<std::int32_t>(share + 0.5f)};
}

// One channel: the columns' values between both rows, then between the columns. `Number` is a 16-bit integer without
// sign, or a vector of such.
template <class Number>
SPS_INLINE Number between_rows(Number top, Number bottom, Number weight) {
  constexpr std::uint16_t kHalf = 1 << (kFirstShift - 1);
  return (top * (kColorSteps - weight) + bottom * weight + kHalf) >> kFirstShift;
}

template <class Number>
SPS_INLINE Number between_columns(Number left, Number right, Number weight) {
  constexpr std::uint16_t kHalf = 1 << (kSecondShift - 1);
  return (left * (kColorSteps - weight) + right * weight + kHalf) >> kSecondShift;
}

}  // namespace spslam
