// The sampling, losses and keys of a render step, as several ops take them.
#pragma once

#include "bindings/common.h"
#include "spslam/render_step.h"

namespace spslam::bindings {

// What a schema says for them, and the arguments of its function.
#define SPS_RENDER_OPTIONS_SCHEMA                                                                   \
  "float[] intrinsics, int num_uniform, int num_surface, float near, float far, float truncation, " \
  "bool cosine_targets, float[] weights, int seed, int stream, int frame, int iteration"
#define SPS_RENDER_OPTIONS_PARAMETERS                                                                              \
  std::vector<double> intrinsics, std::int64_t num_uniform, std::int64_t num_surface, double near, double far,     \
      double truncation, bool cosine_targets, std::vector<double> weights, std::int64_t seed, std::int64_t stream, \
      std::int64_t frame, std::int64_t iteration

inline RenderOptions load_options(const char* function, std::int64_t num_uniform, std::int64_t num_surface, double near,
                                  double far, double truncation, bool cosine_targets,
                                  const std::vector<double>& weights, const PhiloxKey& key, std::int64_t precision) {
  constexpr std::int64_t kMaxSamples = 1 << 16;
  SPS_CHECK(num_uniform >= 0 && num_uniform <= kMaxSamples && num_surface >= 0 && num_surface <= kMaxSamples &&
                num_uniform + num_surface >= 1 && num_uniform + num_surface <= kMaxSamples,
            function, ": the samples of a ray must be from 1 to ", kMaxSamples);
  SPS_CHECK(weights.size() == 4, function, ": weights must be rgb, depth, free_space, sdf");
  SPS_CHECK(precision == 0 || precision == 1, function, ": precision must be 0 (tf32) or 1 (fp32)");
  const auto f = [](double x) { return static_cast<float>(x); };
  return {
      {static_cast<std::int32_t>(num_uniform), static_cast<std::int32_t>(num_surface), f(near), f(far), f(truncation)},
      key,
      {f(weights[0]), f(weights[1]), f(weights[2]), f(weights[3])},
      cosine_targets,
      static_cast<Precision>(precision)};
}

}  // namespace spslam::bindings
