#include "kernels/depth_image_alignment.h"

#include "core/parallel.h"

namespace spslam {
namespace {

// Pixels that are added up before their sums are added to the others', in order.
constexpr std::int64_t kPixelGrain = 128;

// Calls f(i, pair, target) for each pair that exists, on any thread, `target` being what the source is measured
// against.
template <class F>
void for_each_pair(const PixelSets& pixels, const ImagePairs& pairs, std::int64_t images,
                   const GaussNewtonOptions& options, const F& f) {
  parallel_for(pairs.count, 1, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const ImagePair pair = load_pair(pairs, i, pixels.count, images);
      if (!pair.exists) continue;
      EarlierFrames target;
      load_target(options, pair.target, target);
      f(i, pair, target);
    }
  });
}

// terms[kTerms] = sums that add(pixel, sums) adds up over [0, n), chunk by chunk in order.
template <int kTerms, class Add>
void sum_pixels(std::int64_t n, double* terms, const Add& add) {
  for (int t = 0; t < kTerms; ++t) terms[t] = 0.0;
  for (std::int64_t begin = 0; begin < n; begin += kPixelGrain) {
    double own[kTerms] = {};
    for (std::int64_t i = begin; i < n && i < begin + kPixelGrain; ++i) add(i, own);
    for (int t = 0; t < kTerms; ++t) terms[t] += own[t];
  }
}

}  // namespace

template <>
void align_depth_images<Cpu>(Cpu, const PixelSets& pixels, const std::int64_t* numbers, const ImagePairs& pairs,
                             std::int64_t images, const GaussNewtonOptions& options, float* poses) {
  const auto align = [&](std::int64_t i, const ImagePair& pair, const EarlierFrames& target) {
    const std::int32_t* records = pixels.records + pair.source * pixels.pixels_per_set * kPixelWords;
    float* pose = poses + kPoseSize * i;
    PhiloxKey key = options.key;
    key.frame = static_cast<std::uint32_t>(numbers[pair.source]);
    for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
      key.iteration = static_cast<std::uint32_t>(iteration);
      const Measurement measure = measurement(options, &target, iteration);
      const Pose<float> at = load_pose(pose);
      double terms[kKeyframeTerms];
      sum_pixels<kKeyframeTerms>(options.num_pixels, terms, [&](std::int64_t drawn, double* own) {
        const std::int64_t row =
            philox_index(key, static_cast<std::uint32_t>(drawn), static_cast<std::uint64_t>(pixels.pixels_per_set));
        add_alignment_residuals(measure, records + kPixelWords * row, at, own);
      });
      alignment_step(terms, options.damping, pose);
    }
  };
  for_each_pair(pixels, pairs, images, options, align);
}

template <>
void compare_depth_images<Cpu>(Cpu, const PixelSets& pixels, const float* normals, const ImagePairs& pairs,
                               std::int64_t images, const GaussNewtonOptions& options,
                               const ComparisonOptions& comparison, const float* poses, double* sums) {
  const auto compare = [&](std::int64_t i, const ImagePair& pair, const EarlierFrames& target) {
    const std::int64_t first = pair.source * pixels.pixels_per_set;
    const Pose<float> pose = load_pose(poses + kPoseSize * i);
    sum_pixels<kComparisonTerms>(
        pixels.pixels_per_set, sums + kComparisonTerms * i, [&](std::int64_t pixel, double* own) {
          add_comparison(options, target, comparison, pixels.records + kPixelWords * (first + pixel),
                         normals + 3 * (first + pixel), pose, own);
        });
  };
  for_each_pair(pixels, pairs, images, options, compare);
}

}  // namespace spslam
