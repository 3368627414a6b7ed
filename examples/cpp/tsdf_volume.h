// A truncated signed distance field on sparse voxels, fused from depth images with spslam's kernels.
#pragma once

#include <spslam/prior_fusion.h>

#include <cstdint>
#include <vector>

#include "depth_frames.h"
#include "mesh.h"

class TsdfVolume {
 public:
  // Both in meters; the truncation should be two voxels or more.
  TsdfVolume(float voxel_size, float truncation);

  // Allocates the voxels near the frame's surface and averages its distances into all that it sees.
  void integrate(const DepthFrame& frame);

  // The zero level, by marching cubes over the cells whose eight corners have been seen.
  Mesh extract_mesh() const;

  std::int64_t num_voxels() const { return static_cast<std::int64_t>(weights_.size()); }

 private:
  // Channel 0 is the distance over the truncation; the kernel that averages takes rows of eight.
  static constexpr int kChannels = spslam::kPriorFeatures;

  std::vector<std::int32_t> coords_near_surface(const DepthFrame& frame) const;
  void allocate(const std::vector<std::int32_t>& voxel_coords);
  void reserve(std::int64_t voxels);

  float voxel_size_, truncation_;
  std::vector<std::int64_t> hash_keys_;
  std::vector<std::int32_t> hash_values_, voxel_coords_, corner_ids_;
  std::vector<float> features_, weights_;
};
