#include "kernels/depth_planes.h"

#include <algorithm>

#include "core/parallel.h"
#include "cpu/simd.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 8;
// Pixels that are worked on together.
constexpr int kPixelLanes = 64;

// Inverse depth with a border of unknown pixels as wide as the window reaches, and a whole batch on the right.
class InverseDepth {
 public:
  InverseDepth(ScratchBuffer<float>& buffer, const DepthImage& image)
      : stride_(image.width + 2 * kPlaneRadius + kPixelLanes) {
    const std::int64_t rows = image.height + 2 * kPlaneRadius;
    float* begin = buffer.reserve(rows * stride_);
    origin_ = begin + kPlaneRadius * (stride_ + 1);
    parallel_for(rows, kRowGrain, [&](std::int64_t first, std::int64_t last) {
      for (std::int64_t r = first; r < last; ++r) {
        float* row = begin + r * stride_;
        const std::int64_t v = r - kPlaneRadius;
        std::fill(row, row + stride_, kUnknownInverse);
        if (v < 0 || v >= image.height) continue;
        const float* depth = image.depth + v * image.width;
        SPS_SIMD for (std::int32_t u = 0; u < image.width; ++u) row[kPlaneRadius + u] = inverse_depth(depth[u]);
      }
    });
  }

  const float* row(std::int64_t v) const { return origin_ + v * stride_; }

 private:
  std::int64_t stride_;
  const float* origin_;
};

// Adds the row of a window around the pixel at q.
SPS_INLINE void add_row_at(const float* q, const PlaneMiddle& middle, int dv, PlaneSums& sums) {
  add_plane_row(middle, dv, q[-2], q[-1], q[0], q[1], q[2], sums);
}

// Planes of the pixels [first, first + kPixelLanes) of a row that lie in the image.
void planes_of_batch(const DepthImage& image, const InverseDepth& inverse, const PlaneNoise& noise, std::int64_t v,
                     std::int32_t first, float* planes) {
  alignas(64) float by_u[kPixelLanes], by_v[kPixelLanes], gates[kPixelLanes];
  alignas(64) float sums[kPlaneSums][kPixelLanes], out[kPlaneSize][kPixelLanes];
  const float* centers = inverse.row(v) + first;
  const float *above = inverse.row(v - 1) + first, *below = inverse.row(v + 1) + first;
  const Intrinsics camera = image.camera;
  // Not chosen in the loops, where it would keep the compiler from using vectors.
  const DepthNoise whole = noise.depth, own = own_noise(noise);
  SPS_SIMD for (int i = 0; i < kPixelLanes; ++i) {
    const float slope_u = one_sided_slope(centers[i - 1], centers[i], centers[i + 1]);
    const float slope_v = one_sided_slope(above[i], centers[i], below[i]);
    const PlaneMiddle middle = plane_middle(own, camera, centers[i], slope_u, slope_v);
    by_u[i] = middle.by_u;
    by_v[i] = middle.by_v;
    gates[i] = middle.inverse_gate;
  }
  static_assert(kPlaneRadius == 2, "the window's rows are written out");
  const float *highest = inverse.row(v - 2) + first, *lowest = inverse.row(v + 2) + first;
  // All sums of a pixel in one loop, so that they stay in registers.
  SPS_SIMD for (int i = 0; i < kPixelLanes; ++i) {
    PlaneSums s{};
    const PlaneMiddle middle{centers[i], by_u[i], by_v[i], gates[i]};
    add_row_at(highest + i, middle, -2, s);
    add_row_at(above + i, middle, -1, s);
    add_row_at(centers + i, middle, 0, s);
    add_row_at(below + i, middle, 1, s);
    add_row_at(lowest + i, middle, 2, s);
    sums[0][i] = s.one, sums[1][i] = s.u, sums[2][i] = s.v, sums[3][i] = s.uu, sums[4][i] = s.uv;
    sums[5][i] = s.vv, sums[6][i] = s.q, sums[7][i] = s.qu, sums[8][i] = s.qv, sums[9][i] = s.qq;
  }
  const float row = static_cast<float>(v);
  SPS_SIMD for (int i = 0; i < kPixelLanes; ++i) {
    const PlaneSums s{sums[0][i], sums[1][i], sums[2][i], sums[3][i], sums[4][i],
                      sums[5][i], sums[6][i], sums[7][i], sums[8][i], sums[9][i]};
    const MeasuredPlane plane = fit_plane(s, camera, whole, own, static_cast<float>(first + i), row, centers[i]);
    out[0][i] = plane.normal.x;
    out[1][i] = plane.normal.y;
    out[2][i] = plane.normal.z;
    out[3][i] = plane.distance;
    out[4][i] = plane.weight;
  }
  const int count = std::min(kPixelLanes, image.width - first);
  float* to = planes + kPlaneSize * (v * image.width + first);
  for (int i = 0; i < count; ++i) {
    for (int c = 0; c < kPlaneSize; ++c) to[kPlaneSize * i + c] = out[c][i];
  }
}

}  // namespace

template <>
void measure_planes<Cpu>(Cpu, const DepthImage& image, const PlaneNoise& noise, float* planes) {
  if (image.width == 0 || image.height == 0) return;
  ScratchBuffer<float> buffer;
  const InverseDepth inverse(buffer, image);
  parallel_for(image.height, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t v = begin; v < end; ++v) {
      for (std::int32_t u = 0; u < image.width; u += kPixelLanes) planes_of_batch(image, inverse, noise, v, u, planes);
    }
  });
}

}  // namespace spslam
