#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "launch/prior_fusion.h"
#include "launch/voxel_hash.h"

namespace spslam {
namespace {

// The normals of the first max_points points that have one; 0 for the others.
std::vector<float> first_normals(const float* normals, std::int64_t n, std::int64_t max_points) {
  std::vector<float> kept(static_cast<std::size_t>(3 * n), 0.0f);
  std::int64_t count = 0;
  for (std::int64_t i = 0; i < n && count < max_points; ++i) {
    const float* normal = normals + 3 * i;
    if (normal[0] == 0.0f && normal[1] == 0.0f && normal[2] == 0.0f) continue;
    std::copy_n(normal, 3, kept.data() + 3 * i);
    ++count;
  }
  return kept;
}

// Encoded vertices without those of too little weight.
struct EncodedVertices {
  EncodedVertices(const float* points, const float* normals, std::int64_t n, const float* params,
                  const FusionSettings& settings) {
    const std::vector<float> first = first_normals(normals, n, settings.max_points);
    encode_points(Cpu{}, points, first.data(), n, params, settings.encoder, AllocateScratch{},
                  [&](std::int64_t vertices) {
                    resize(vertices);
                    return EncodedVoxels{coords.data(), features.data(), weights.data()};
                  });
    std::int64_t kept = 0;
    for (std::int64_t i = 0; i < count; ++i) {
      if (!(weights[i] > settings.min_weight)) continue;
      std::copy_n(coords.data() + 3 * i, 3, coords.data() + 3 * kept);
      std::copy_n(features.data() + kPriorFeatures * i, kPriorFeatures, features.data() + kPriorFeatures * kept);
      weights[kept++] = fusion_share(weights[i], settings.kappa);
    }
    resize(kept);
  }

  void resize(std::int64_t vertices) {
    count = vertices;
    coords.resize(static_cast<std::size_t>(3 * count));
    features.resize(static_cast<std::size_t>(kPriorFeatures * count));
    weights.resize(static_cast<std::size_t>(count));
  }

  std::int64_t count = 0;
  std::vector<std::int32_t> coords;
  std::vector<float> features, weights;
};

void find_bounds(const float* points, std::int64_t n, EncodedFrame* frame) {
  for (int a = 0; a < 3; ++a) {
    frame->low[a] = std::numeric_limits<float>::infinity();
    frame->high[a] = -frame->low[a];
  }
  for (std::int64_t i = 0; i < n; ++i) {
    const float* p = points + 3 * i;
    if (!(std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]))) continue;
    for (int a = 0; a < 3; ++a) {
      frame->low[a] = std::min(frame->low[a], p[a]);
      frame->high[a] = std::max(frame->high[a], p[a]);
    }
  }
}

// Enters the vertices named by sorted keys as num_voxels, num_voxels + 1, ...
void enter_voxels(const FeatureVolume& volume, const std::vector<std::int64_t>& keys, std::int64_t count) {
  const std::int64_t first = volume.num_voxels;
  voxel_hash_assign(Cpu{}, volume.hash_keys, volume.hash_values, volume.hash_capacity, keys.data(), count,
                    static_cast<std::int32_t>(first));
  voxel_hash_unpack(Cpu{}, keys.data(), count, volume.voxel_coords + 3 * first);
  voxel_hash_update_corner_ids(Cpu{}, volume.hash_keys, volume.hash_values, volume.hash_capacity, volume.voxel_coords,
                               first + count, first, volume.corner_ids);
}

}  // namespace

template <>
EncodedFrame encode_frame<Cpu>(Cpu device, const FeatureVolume& volume, const float* points, const float* normals,
                               std::int64_t n, const float* params, const FusionSettings& settings,
                               const AllocateScratch&) {
  EncodedFrame frame{};
  find_bounds(points, n, &frame);
  const EncodedVertices vertices(points, normals, n, params, settings);
  std::vector<std::int64_t> absent(static_cast<std::size_t>(vertices.count));
  frame.new_voxels = voxel_hash_absent(device, volume.hash_keys, volume.hash_values, volume.hash_capacity,
                                       vertices.coords.data(), vertices.count, nullptr, absent.data())
                         .count;
  frame.fits = volume.num_voxels + frame.new_voxels <= volume.max_voxels;
  if (!frame.fits) return frame;
  enter_voxels(volume, absent, frame.new_voxels);
  std::vector<std::int32_t> ids(static_cast<std::size_t>(vertices.count));
  voxel_hash_find(device, volume.hash_keys, volume.hash_values, volume.hash_capacity, vertices.coords.data(),
                  vertices.count, ids.data());
  if (!settings.fuse_known) {
    for (std::int32_t& id : ids) id = id < volume.num_voxels ? kNoVoxel : id;
  }
  fuse_prior(device, ids.data(), vertices.features.data(), vertices.weights.data(), vertices.count,
             volume.num_voxels + frame.new_voxels, settings.max_weight, volume.embeddings, volume.weights);
  return frame;
}

}  // namespace spslam
