// The color image of one camera brought to the view of a depth camera beside it. On the host alone, by the thread that
// calls: images are read there, several at a time.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// Where the color camera sees a pixel (u, v) of the depth camera with depth z (m): at (x / w, y / w), w being the depth
// (m) from there, with (x, y, w) = z (by_u u + by_v v + constant) + offset.
struct PixelMap {
  float by_u[3], by_v[3], constant[3], offset[3];
};

struct ColorRegistration {
  PixelMap map;
  std::int32_t color_width, color_height, width, height;
  // Size of the depth buffer of the color camera's view; 0 where both cameras are in one place, so that nothing hides.
  std::int32_t cells_wide, cells_high;
  // Of pixels without depth, m: where their color is looked for.
  float typical_depth;
  // A point is hidden if the depth buffer has one there, or in a cell beside, that is nearer by this share.
  float hidden_share;
};

// The images that are read: colors [color_height, color_width, 3], or null where only depth is wanted, unseen
// [color_height, color_width] not 0 where colors have no content, or null, and depth [height, width], m.
struct RegisteredImages {
  const std::uint8_t* colors;
  const std::uint8_t* unseen;
  const float* depth;
};

// Writes colors [height, width, 3], linearly interpolated and repeated beyond the border, unless they are null, and
// depth [height, width]: 0 where it was, or where the color camera doesn't see the point.
void register_color(Cpu device, const ColorRegistration& registration, const RegisteredImages& images,
                    std::uint8_t* colors, float* depth);

}  // namespace spslam
