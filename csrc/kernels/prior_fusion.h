// The scene prior, for one element: fusion of a feature into a voxel's embedding.
#pragma once

#include <cstdint>

#include "core/macros.h"

namespace spslam {

constexpr int kPriorFeatures = 8;

// embedding = (weight * embedding + feature_weight * feature) / (weight + feature_weight), then the weight grows up to
// max_weight. A feature without weight changes nothing.
SPS_INLINE void fuse_feature(const float* feature, float feature_weight, float max_weight, float* embedding,
                             float* weight) {
  const float total = *weight + feature_weight;
  if (!(feature_weight > 0.0f)) return;
  const float share = feature_weight / total;
  for (int c = 0; c < kPriorFeatures; ++c) embedding[c] += share * (feature[c] - embedding[c]);
  *weight = total < max_weight ? total : max_weight;
}

}  // namespace spslam
