// Launches of prior_fusion that are the same for every device.
#pragma once

#include "core/for_each.h"
#include "kernels/prior_fusion.h"
#include "kernels/voxel_hash.h"
#include "spslam/prior_fusion.h"

namespace spslam {

template <class Device>
void fuse_prior(Device device, const std::int32_t* voxel_ids, const float* features, const float* feature_weights,
                std::int64_t count, std::int64_t num_voxels, float max_weight, float* embeddings, float* weights) {
  for_each(device, count, [=] SPS_HOST_DEVICE(std::int64_t i) {
    const std::int64_t id = voxel_ids[i];
    if (id < 0 || id >= num_voxels) return;
    fuse_feature(features + kPriorFeatures * i, feature_weights[i], max_weight, embeddings + kPriorFeatures * id,
                 weights + id);
  });
}

template <class Device>
void random_embeddings(Device device, const std::int32_t* voxel_coords, std::int64_t n, std::int64_t seed, float scale,
                       float* embeddings) {
  for_each(device, n, [=] SPS_HOST_DEVICE(std::int64_t i) {
    random_embedding(static_cast<std::uint64_t>(seed), load_voxel(voxel_coords, i), scale,
                     embeddings + kPriorFeatures * i);
  });
}

#define SPS_INSTANTIATE_PRIOR_FUSION(Device)                                                              \
  template void fuse_prior<Device>(Device, const std::int32_t*, const float*, const float*, std::int64_t, \
                                   std::int64_t, float, float*, float*);                                  \
  template void random_embeddings<Device>(Device, const std::int32_t*, std::int64_t, std::int64_t, float, float*);

}  // namespace spslam
