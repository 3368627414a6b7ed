// The camera, sampling, losses and keys of a render step, as several ops take them.
#pragma once

#include "bindings/number_list.h"
#include "spslam/render_step.h"

namespace spslam::bindings {

// What a schema says for them.
#define SPS_RENDER_SCHEMA "float[] render_scalars, int[] render_integers"

// Places in these lists; RenderOptions.arguments in spslam/ops/render_step.py fills them.
enum class RenderScalar {
  kFx,
  kFy,
  kCx,
  kCy,
  kNear,
  kFar,
  kTruncation,
  kWeightRgb,
  kWeightDepth,
  kWeightFreeSpace,
  kWeightSdf,
  kCount
};
enum class RenderInteger {
  kNumUniform,
  kNumSurface,
  kCosineTargets,
  kSeed,
  kStream,
  kFrame,
  kIteration,
  kPrecision,
  kCount
};

struct RenderArgument {
  RenderArgument(const char* function, const std::vector<double>& scalar_list,
                 const std::vector<std::int64_t>& integer_list) {
    using S = RenderScalar;
    using I = RenderInteger;
    const Scalars<S> scalars(function, "render_scalars", scalar_list);
    const Integers<I> integers(function, "render_integers", integer_list);
    constexpr std::int64_t kMaxSamples = 1 << 16;
    const std::int64_t uniform = integers[I::kNumUniform], surface = integers[I::kNumSurface];
    SPS_CHECK(uniform >= 0 && uniform <= kMaxSamples && surface >= 0 && surface <= kMaxSamples &&
                  uniform + surface >= 1 && uniform + surface <= kMaxSamples,
              function, ": the samples of a ray must be from 1 to ", kMaxSamples);
    const std::int64_t precision = integers[I::kPrecision];
    SPS_CHECK(precision == 0 || precision == 1, function, ": precision must be 0 (tf32) or 1 (fp32), got ", precision);
    intrinsics = load_intrinsics(scalars);
    options.sampling = {static_cast<std::int32_t>(uniform), static_cast<std::int32_t>(surface),
                        scalars.as<float>(S::kNear), scalars.as<float>(S::kFar), scalars.as<float>(S::kTruncation)};
    options.key = load_key(integers, integers[I::kIteration]);
    options.weights = {scalars.as<float>(S::kWeightRgb), scalars.as<float>(S::kWeightDepth),
                       scalars.as<float>(S::kWeightFreeSpace), scalars.as<float>(S::kWeightSdf)};
    options.cosine_targets = integers.as<bool>(I::kCosineTargets);
    options.precision = static_cast<Precision>(precision);
  }

  // The key of the pixels' draw: the rays' of another stream.
  PhiloxKey pixel_key(std::int64_t stream) const {
    PhiloxKey key = options.key;
    key.stream = static_cast<std::uint32_t>(stream);
    return key;
  }

  Intrinsics intrinsics;
  RenderOptions options;
};

}  // namespace spslam::bindings
