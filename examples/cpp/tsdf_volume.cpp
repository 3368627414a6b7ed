#include "tsdf_volume.h"

#include <spslam/core/parallel.h>
#include <spslam/marching_cubes.h>
#include <spslam/voxel_hash.h>

#include <cmath>
#include <limits>
#include <numeric>

namespace {

constexpr spslam::Cpu kCpu;
constexpr float kMaxWeight = 100;
constexpr std::int64_t kGrain = 4096;

std::int64_t rows(const std::vector<std::int32_t>& coords) {
  return static_cast<std::int64_t>(coords.size() / 3);
}

// The measured depth at a camera point's pixel, 0 where there is none.
float depth_at(const DepthFrame& frame, const Vector3& point) {
  if (point[2] <= 0) return 0;
  const float u = frame.intrinsics.fx * point[0] / point[2] + frame.intrinsics.cx;
  const float v = frame.intrinsics.fy * point[1] / point[2] + frame.intrinsics.cy;
  const bool inside = u > -0.5f && v > -0.5f && u < static_cast<float>(frame.intrinsics.width) - 0.5f &&
                      v < static_cast<float>(frame.intrinsics.height) - 0.5f;
  if (!inside) return 0;
  return frame.depth[std::lround(v) * frame.intrinsics.width + std::lround(u)];
}

}  // namespace

TsdfVolume::TsdfVolume(float voxel_size, float truncation) : voxel_size_(voxel_size), truncation_(truncation) {
  reserve(1 << 15);
}

void TsdfVolume::integrate(const DepthFrame& frame) {
  allocate(coords_near_surface(frame));
  const std::int64_t voxels = num_voxels();
  std::vector<std::int32_t> ids(voxels);
  std::iota(ids.begin(), ids.end(), 0);
  std::vector<float> features(voxels * kChannels), weights(voxels);
  spslam::parallel_for(voxels, kGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int32_t* c = voxel_coords_.data() + 3 * i;
      const Vector3 point =
          frame.to_camera({voxel_size_ * static_cast<float>(c[0]), voxel_size_ * static_cast<float>(c[1]),
                           voxel_size_ * static_cast<float>(c[2])});
      const float depth = depth_at(frame, point), distance = depth - point[2];
      // What lies deeper behind the surface than the truncation is hidden from this view.
      if (depth <= 0 || distance < -truncation_) continue;
      features[i * kChannels] = std::fmin(distance / truncation_, 1.0f);
      weights[i] = 1;
    }
  });
  spslam::fuse_prior(kCpu, ids.data(), features.data(), weights.data(), voxels, voxels, kMaxWeight, features_.data(),
                     weights_.data());
}

Mesh TsdfVolume::extract_mesh() const {
  std::vector<std::int32_t> cells;
  std::vector<float> values;
  for (std::int64_t i = 0; i < num_voxels(); ++i) {
    const std::int32_t* corners = corner_ids_.data() + 8 * i;
    if (corners[0] < 0) continue;
    cells.insert(cells.end(), voxel_coords_.data() + 3 * i, voxel_coords_.data() + 3 * i + 3);
    // Marching cubes wants z fastest; corner k of a cell lies at offset (k & 1, k >> 1 & 1, k >> 2 & 1).
    for (int k : {0, 4, 2, 6, 1, 5, 3, 7}) {
      const std::int32_t id = corners[k];
      values.push_back(weights_[id] > 0 ? features_[id * kChannels] : std::numeric_limits<float>::quiet_NaN());
    }
  }
  const spslam::MarchingCubesCells input{cells.data(), values.data(), rows(cells), 1, 0.0f};
  std::vector<std::uint8_t> workspace(spslam::marching_cubes_workspace_bytes(kCpu, input.count, input.n));
  const spslam::MarchingCubesCounts counts = spslam::marching_cubes_count(kCpu, input, workspace.data());
  Mesh mesh{std::vector<float>(3 * counts.vertices), std::vector<std::int64_t>(3 * counts.faces)};
  spslam::marching_cubes_fill(kCpu, input, workspace.data(), mesh.vertices.data(), mesh.faces.data());
  for (float& v : mesh.vertices) v *= voxel_size_;
  return mesh;
}

// The corners of the cells that each pixel's ray passes within the truncation of its surface; with repetitions.
std::vector<std::int32_t> TsdfVolume::coords_near_surface(const DepthFrame& frame) const {
  std::vector<std::int32_t> coords;
  for (int v = 0; v < frame.intrinsics.height; ++v) {
    for (int u = 0; u < frame.intrinsics.width; ++u) {
      const float depth = frame.depth[v * frame.intrinsics.width + u];
      if (depth <= 0) continue;
      for (float offset = -truncation_; offset <= truncation_; offset += voxel_size_) {
        const Vector3 point = frame.to_world(static_cast<float>(u), static_cast<float>(v), depth + offset);
        for (int k = 0; k < 8; ++k) {
          for (int axis = 0; axis < 3; ++axis) {
            coords.push_back(static_cast<std::int32_t>(std::floor(point[axis] / voxel_size_)) + (k >> axis & 1));
          }
        }
      }
    }
  }
  return coords;
}

void TsdfVolume::allocate(const std::vector<std::int32_t>& voxel_coords) {
  const std::int64_t n = rows(voxel_coords), first_new = num_voxels();
  std::vector<std::int64_t> absent(n);
  std::vector<std::uint8_t> workspace(spslam::voxel_hash_workspace_bytes(kCpu, n));
  const std::int64_t count = spslam::voxel_hash_absent(kCpu, hash_keys_.data(), hash_values_.data(),
                                                       static_cast<std::int64_t>(hash_keys_.size()),
                                                       voxel_coords.data(), n, workspace.data(), absent.data())
                                 .count;
  const std::int64_t total = first_new + count;
  reserve(total);
  const auto capacity = static_cast<std::int64_t>(hash_keys_.size());
  spslam::voxel_hash_assign(kCpu, hash_keys_.data(), hash_values_.data(), capacity, absent.data(), count,
                            static_cast<std::int32_t>(first_new));
  voxel_coords_.resize(3 * total);
  spslam::voxel_hash_unpack(kCpu, absent.data(), count, voxel_coords_.data() + 3 * first_new);
  features_.resize(kChannels * total);
  weights_.resize(total);
  corner_ids_.resize(8 * total);
  spslam::voxel_hash_update_corner_ids(kCpu, hash_keys_.data(), hash_values_.data(), capacity, voxel_coords_.data(),
                                       total, first_new, corner_ids_.data());
}

// Keeps the table at most half full: a larger one is filled anew, ids as they are.
void TsdfVolume::reserve(std::int64_t voxels) {
  auto capacity = static_cast<std::int64_t>(hash_keys_.size());
  if (2 * voxels <= capacity) return;
  for (capacity = 2; capacity < 4 * voxels;) capacity *= 2;
  hash_keys_.assign(capacity, -1);
  hash_values_.assign(capacity, 0);
  std::vector<std::int64_t> keys(num_voxels());
  spslam::voxel_hash_pack(kCpu, voxel_coords_.data(), num_voxels(), keys.data());
  spslam::voxel_hash_assign(kCpu, hash_keys_.data(), hash_values_.data(), capacity, keys.data(), num_voxels(), 0);
}
