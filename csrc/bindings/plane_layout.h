// Where the planes of a tri-plane lie in their table of texels, as several ops take it.
#pragma once

#include "bindings/common.h"
#include "spslam/interpolation.h"

namespace spslam::bindings {

// From 15 integers, (offset, origin_u, origin_v, size_u, size_v) of each plane, which come from a user or a file: none
// may lead outside of a table of `rows` texels, and no sum of them outside of its integer.
inline TriPlaneLayout load_plane_layout(const char* function, const std::vector<std::int64_t>& layout,
                                        std::int64_t rows) {
  constexpr std::int64_t kFarthest = std::int64_t{1} << 30;
  SPS_CHECK(layout.size() == 15, function, ": plane layout must have 15 numbers, got ", layout.size());
  TriPlaneLayout out;
  for (int plane = 0; plane < 3; ++plane) {
    const std::int64_t* p = layout.data() + 5 * plane;
    const std::int64_t offset = p[0], size_u = p[3], size_v = p[4];
    SPS_CHECK(size_u >= 0 && size_v >= 0 && size_u <= kFarthest && size_v <= kFarthest && offset >= 0 &&
                  offset <= rows && size_u * size_v <= rows - offset,
              function, ": plane layout must lie within the ", rows, " texels, got offset ", offset, " and size ",
              size_u, " x ", size_v);
    for (int axis = 1; axis <= 2; ++axis) {
      SPS_CHECK(p[axis] >= -kFarthest && p[axis] <= kFarthest, function,
                ": origins of a plane layout must be in [-2^30, 2^30], got ", p[axis]);
    }
    out.planes[plane] = {offset, static_cast<std::int32_t>(p[1]), static_cast<std::int32_t>(p[2]),
                         static_cast<std::int32_t>(size_u), static_cast<std::int32_t>(size_v)};
  }
  return out;
}

}  // namespace spslam::bindings
