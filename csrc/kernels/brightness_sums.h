// The maths of comparing an image's brightness with what earlier frames have seen there.
// In float64, as whether a frame sees a point (kernels/covisibility.h); brightness is summed as whole numbers, so that
// the order does not matter.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "kernels/covisibility.h"
#include "spslam/brightness_sums.h"

namespace spslam {

constexpr double kBrightnessLevels = 65535.0;

// The sums of a cell: of 1, of both brightnesses in levels, and of their squares and product.
enum BrightnessSum { kPoints, kStored, kShown, kStoredStored, kShownShown, kStoredShown, kBrightnessSums };

struct PointBrightness {
  std::int64_t cell;  // of the frame's image; -1 where the image does not show the point
  std::int64_t stored, shown;
};

SPS_INLINE std::int64_t cells_of_frame(const SeenPixels& seen) {
  return seen.cells_in_a_row * seen.cells_in_a_row;
}

SPS_INLINE bool is_row(const SeenPixels& seen, std::int64_t row) {
  return row >= 0 && row < seen.num_frames;
}

SPS_INLINE std::int64_t stored_brightness(const std::int32_t* record) {
  constexpr double kWhite = 255.0 * (kLumaWeights[0] + kLumaWeights[1] + kLumaWeights[2]);
  const std::uint32_t color = static_cast<std::uint32_t>(record[2]);
  const std::int64_t luma = kLumaWeights[0] * (color & 0xFFu) + kLumaWeights[1] * (color >> 8 & 0xFFu) +
                            kLumaWeights[2] * (color >> 16 & 0xFFu);
  return static_cast<std::int64_t>(std::rint(static_cast<double>(luma) * (kBrightnessLevels / kWhite)));
}

SPS_INLINE std::int64_t cell_of_pixel(const SeenPixels& seen, const std::int32_t* record) {
  const std::uint32_t place = static_cast<std::uint32_t>(record[0]);
  const std::int64_t column = static_cast<std::int64_t>(place & 0xFFFFu) * seen.cells_in_a_row / seen.columns;
  const std::int64_t row = static_cast<std::int64_t>(place >> 16) * seen.cells_in_a_row / seen.rows;
  const std::int64_t last = seen.cells_in_a_row - 1;
  return (row < last ? row : last) * seen.cells_in_a_row + (column < last ? column : last);
}

// A pixel of a frame at `pose`, as images at `own` show it.
SPS_INLINE PointBrightness compared_brightness(const SeenPixels& seen, const std::int32_t* record,
                                               const Pose<double>& pose, const ShownImages& shown,
                                               const Pose<double>& own) {
  constexpr PointBrightness kNothing{-1, 0, 0};
  const auto [x, y, z] = in_frame(own, pixel_point(record, pose, seen.intrinsics));
  if (!(z > kMinPointDepth)) return kNothing;
  const Intrinsics& k = shown.intrinsics;
  const double u = x / z * k.fx + k.cx, v = y / z * k.fy + k.cy;
  if (!(u >= 0.0 && v >= 0.0 && u < static_cast<double>(shown.columns - 1) &&
        v < static_cast<double>(shown.rows - 1))) {
    return kNothing;
  }
  const std::int64_t nearest = static_cast<std::int64_t>(v + 0.5) * shown.columns + static_cast<std::int64_t>(u + 0.5);
  if (!(std::fabs(shown.depth[nearest] * shown.unit_m - z) < shown.tolerance * z)) return kNothing;
  const double left = std::floor(u), top = std::floor(v);
  const std::uint8_t* at =
      shown.intensity + static_cast<std::int64_t>(top) * shown.columns + static_cast<std::int64_t>(left);
  const double a = u - left, b = v - top;
  const double upper = (1.0 - a) * at[0] + a * at[1];
  const double lower = (1.0 - a) * at[shown.columns] + a * at[shown.columns + 1];
  const double value = (1.0 - b) * upper + b * lower;
  return {cell_of_pixel(seen, record), stored_brightness(record),
          static_cast<std::int64_t>(std::rint(value * (kBrightnessLevels / 255.0)))};
}

// What a point adds to the sums [6] of its cell, by add(which, value).
template <class Add>
SPS_INLINE void add_brightness(const PointBrightness& point, const Add& add) {
  add(kPoints, std::int64_t{1});
  add(kStored, point.stored);
  add(kShown, point.shown);
  add(kStoredStored, point.stored * point.stored);
  add(kShownShown, point.shown * point.shown);
  add(kStoredShown, point.stored * point.shown);
}

// `sums` [5] of the sums [num_cells, 6] of all cells; see sum_brightness.
SPS_INLINE void finish_brightness(const std::int64_t* cells, std::int64_t num_cells, double* sums) {
  constexpr double kLevel = 1.0 / kBrightnessLevels;
  double points = 0.0, brightness = 0.0, stored = 0.0, shown = 0.0, both = 0.0;
  for (std::int64_t i = 0; i < num_cells; ++i) {
    const std::int64_t* cell = cells + kBrightnessSums * i;
    if (cell[kPoints] == 0) continue;
    const double n = static_cast<double>(cell[kPoints]);
    const double m = static_cast<double>(cell[kStored]), b = static_cast<double>(cell[kShown]);
    points += n;
    brightness += b;
    stored += static_cast<double>(cell[kStoredStored]) - m * m / n;
    shown += static_cast<double>(cell[kShownShown]) - b * b / n;
    both += static_cast<double>(cell[kStoredShown]) - m * b / n;
  }
  sums[0] = points;
  sums[1] = brightness * kLevel;
  sums[2] = stored * (kLevel * kLevel);
  sums[3] = shown * (kLevel * kLevel);
  sums[4] = both * (kLevel * kLevel);
}

}  // namespace spslam
