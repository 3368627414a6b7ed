// First part of render_step on the CPU: rays, samples along them, and which samples lie in complete cells.
//
// The tables are far larger than the caches, so every look-up is split into passes over the chunk, and each pass
// prefetches what the next one reads.
#pragma once

#include "cpu/render_step_chunk.h"
#include "kernels/interpolation.h"
#include "kernels/ray_sampling.h"
#include "kernels/voxel_hash.h"

namespace spslam::render {

inline void load_rays(const RayBatch& batch, const RenderOptions& options, std::int64_t begin, std::int64_t end,
                      Chunk& chunk) {
  const Intrinsics& k = batch.intrinsics;
  chunk.num_rays = end - begin;
  std::int32_t pose_frame = -1;
  Pose<float> pose{};
  for (std::int64_t i = 0; i < chunk.num_rays; ++i) {
    Ray& ray = chunk.rays[i];
    ray.origin = ray.direction = {};
    ray.pixel = unpack_pixel(batch.pixels + kPixelWords * (begin + i));
    ray.frame = batch.ray_frames[begin + i];
    ray.valid = has_depth(ray.pixel.depth) && ray.frame >= 0 && ray.frame < batch.num_frames;
    ray.cosine = options.cosine_targets ? ray.pixel.foreshortening : 1.0f;
    chunk.pose_gradients[i] = {};
    if (!ray.valid) continue;
    if (ray.frame != pose_frame) pose = load_pose(batch.poses + 7 * static_cast<std::int64_t>(ray.frame));
    pose_frame = ray.frame;
    ray.origin = pose.translation;
    ray.direction = pose.rotation * pixel_ray(ray.pixel, k);
  }
}

// Packed coordinates of the cells around the samples of a ray; kEmptyVoxelKey out of range.
inline void sample_keys(const Ray& ray, float inverse_voxel, const float* depths, std::int32_t count,
                        std::int64_t* keys) {
  constexpr float kLow = kVoxelCoordMin, kHigh = kVoxelCoordMax;
  const Vec3<float> o = ray.origin, d = ray.direction;
#pragma omp simd
  for (std::int32_t s = 0; s < count; ++s) {
    const float x = std::floor((o.x + depths[s] * d.x) * inverse_voxel);
    const float y = std::floor((o.y + depths[s] * d.y) * inverse_voxel);
    const float z = std::floor((o.z + depths[s] * d.z) * inverse_voxel);
    const bool inside = (x >= kLow) & (x <= kHigh) & (y >= kLow) & (y <= kHigh) & (z >= kLow) & (z <= kHigh);
    const std::int64_t key =
        pack_voxel({static_cast<std::int32_t>(inside ? x : 0.0f), static_cast<std::int32_t>(inside ? y : 0.0f),
                    static_cast<std::int32_t>(inside ? z : 0.0f)});
    keys[s] = inside ? key : kEmptyVoxelKey;
  }
}

// Draws the samples, and lists the distinct cells along each ray: neighbors in the same cell share one look-up.
inline void sample_rays(const SceneView& scene, const RenderOptions& options, std::int64_t first_ray, Chunk& chunk) {
  const std::int32_t count = chunk.samples_per_ray;
  const float inverse_voxel = 1.0f / scene.voxel_size;
  chunk.num_cells = 0;
  for (std::int64_t i = 0; i < chunk.num_rays; ++i) {
    const Ray& ray = chunk.rays[i];
    if (!ray.valid) continue;
    float* depths = chunk.depths + i * count;
    std::int32_t* cell_of = chunk.cell_of + i * count;
    sample_ray(options.key, options.sampling, first_ray + i, ray.pixel.depth, chunk.depth_scratch, depths);
    sample_keys(ray, inverse_voxel, depths, count, chunk.keys);
    std::int64_t last_key = kEmptyVoxelKey;
    for (std::int32_t s = 0; s < count; ++s) {
      const std::int64_t key = chunk.keys[s];
      if (key != last_key && key != kEmptyVoxelKey) {
        ChunkCell& cell = chunk.cells[chunk.num_cells];
        cell.slot = voxel_slot(key, scene.table.mask);
        __builtin_prefetch(scene.table.keys + cell.slot);
        cell.key = key;
        ++chunk.num_cells;
      }
      last_key = key;
      cell_of[s] = key == kEmptyVoxelKey ? -1 : static_cast<std::int32_t>(chunk.num_cells - 1);
    }
  }
}

// Turns cell keys into voxel ids, kNoVoxel for cells that are not complete.
inline void find_cells(const SceneView& scene, Chunk& chunk) {
  const VoxelTable& table = scene.table;
  for (std::int64_t c = 0; c < chunk.num_cells; ++c) {
    ChunkCell& cell = chunk.cells[c];
    const std::int64_t first = cell.slot;
    while (table.keys[cell.slot] != cell.key && table.keys[cell.slot] != kEmptyVoxelKey) {
      cell.slot = (cell.slot + 1) & table.mask;
      if (cell.slot == first) break;  // a table without an empty slot
    }
    const bool found = table.keys[cell.slot] == cell.key;
    cell.voxel_id = found ? 0 : kNoVoxel;
    if (found) __builtin_prefetch(table.values + cell.slot);
  }
  for (std::int64_t c = 0; c < chunk.num_cells; ++c) {
    ChunkCell& cell = chunk.cells[c];
    if (cell.voxel_id == kNoVoxel) continue;
    cell.voxel_id = table.values[cell.slot];
    if (cell.voxel_id >= scene.num_voxels) cell.voxel_id = kNoVoxel;
    if (cell.voxel_id >= 0) __builtin_prefetch(scene.corner_ids + kCellCorners * std::int64_t{cell.voxel_id});
  }
  for (std::int64_t c = 0; c < chunk.num_cells; ++c) {
    ChunkCell& cell = chunk.cells[c];
    if (cell.voxel_id < 0) continue;
    const std::int32_t* corners = scene.corner_ids + kCellCorners * std::int64_t{cell.voxel_id};
    if (complete_cell(corners, scene.num_voxels)) {
      for (int k = 0; k < kCellCorners; ++k) {
        __builtin_prefetch(scene.embeddings + kEmbeddingChannels * std::int64_t{corners[k]});
      }
    } else {
      cell.voxel_id = kNoVoxel;
    }
  }
}

// Lists the samples inside complete cells, and counts those in free space, wherever they are.
inline void compact_samples(const RenderOptions& options, Chunk& chunk) {
  const std::int32_t count = chunk.samples_per_ray;
  const float truncation = options.sampling.truncation;
  std::int32_t n = 0;
  for (std::int64_t i = 0; i < chunk.num_rays; ++i) {
    Ray& ray = chunk.rays[i];
    ray.begin = n;
    std::int32_t num_free = 0, num_near = 0;
    const float* depths = chunk.depths + i * count;
    const std::int32_t* cell_of = chunk.cell_of + i * count;
    for (std::int32_t s = 0; ray.valid && s < count; ++s) {
      const std::int32_t voxel = cell_of[s] < 0 ? kNoVoxel : chunk.cells[cell_of[s]].voxel_id;
      const bool inside = voxel != kNoVoxel;
      const float distance = target_distance(ray.pixel.depth, depths[s], ray.cosine);
      num_free += in_free_space(distance, truncation);
      num_near += near_surface(distance, truncation, inside);
      chunk.t[n] = depths[s];
      chunk.voxel_of[n] = voxel;
      chunk.ray_of[n] = static_cast<std::int32_t>(i);
      n += inside;
    }
    ray.num_free = num_free;
    ray.num_near = num_near;
    ray.end = n;
  }
  chunk.num_inside = n;
}

}  // namespace spslam::render
