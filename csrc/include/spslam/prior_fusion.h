// The scene prior: normals of a depth image, the depth encoder, and its fusion into the sparse volume.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// Equation (1) of SP-SLAM on rows voxel_ids of an [V, 8] volume: weighted mean of what is there and what is new, the
// total weight capped. Rows outside [0, V) are skipped; the ids are distinct.
template <class Device>
void fuse_prior(Device device, const std::int32_t* voxel_ids, const float* features, const float* feature_weights,
                std::int64_t count, std::int64_t num_voxels, float max_weight, float* embeddings, float* weights);

}  // namespace spslam
