// Where the texels of the three feature planes lie in their table.
#pragma once

#include <cstdint>

namespace spslam {

// Where one plane of texels lies: rows [offset, offset + size_u * size_v) of the table, v fastest; texel (iu, iv) of
// the world is row offset + (iu - origin_u) * size_v + (iv - origin_v).
struct PlaneLayout {
  std::int64_t offset;
  std::int32_t origin_u, origin_v, size_u, size_v;
};

// The xy, xz and yz planes.
struct TriPlaneLayout {
  PlaneLayout planes[3];
};

}  // namespace spslam
