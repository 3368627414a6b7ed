// Registration of many pairs of depth images at once: where each source lies in its target's axes, and how well the two
// fit there.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// Pixels of N frames, drawn in advance, P of each.
struct PixelSets {
  const std::int32_t* records;  // [N, P, kPixelWords], coordinates in the images' pixels
  std::int64_t count, pixels_per_set;
};

// Rows of a source's pixels and of its target's image. Pairs with a row that does not exist are left as they are.
struct ImagePairs {
  const std::int64_t* rows;  // [B, 2]
  std::int64_t count;
};

// Sums over the pixels of a pair, as whole numbers: seen, on the surface, clearly before it; of the source's and the
// target's intensities on the surface: both, their squares, their product; then the upper triangle of J^T J, row by
// row.
constexpr int kComparisonCounts = 3, kComparisonMoments = 5, kComparisonNormals = 21;
constexpr int kComparisonTerms = kComparisonCounts + kComparisonMoments + kComparisonNormals;

struct ComparisonOptions {
  float tolerance;             // m
  float tolerance_deviations;  // of depth's noise, added to it
  float clear_tolerances;      // so many times the tolerance before the surface is clearly before it
};

// Gauss-Newton on the pixels of each pair's source against its target's image alone. options.depth_keyframes holds the
// R images, and one keyframe in use, of which only the kernel counts; options.key.frame is replaced by numbers [N] of
// the sources. poses [B, 7] T_target_source are read and overwritten.
template <class Device>
void align_depth_images(Device device, const PixelSets& pixels, const std::int64_t* numbers, const ImagePairs& pairs,
                        std::int64_t images, const GaussNewtonOptions& options, float* poses);

// sums [B, kComparisonTerms] at poses [B, 7]; normals [N, P, 3] of the pixels' surface, 0 where unknown.
// options.intrinsics (of the pixels), noise and depth_keyframes are as above.
template <class Device>
void compare_depth_images(Device device, const PixelSets& pixels, const float* normals, const ImagePairs& pairs,
                          std::int64_t images, const GaussNewtonOptions& options, const ComparisonOptions& comparison,
                          const float* poses, double* sums);

}  // namespace spslam
