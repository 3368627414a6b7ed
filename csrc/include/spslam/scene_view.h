// The scene as the fused kernels read it: sparse volume, tri-planes and the two decoders.
#pragma once

#include <cstdint>

#include "spslam/decoders.h"
#include "spslam/types/camera.h"
#include "spslam/types/tri_plane_layout.h"
#include "spslam/types/voxel_table.h"

namespace spslam {

constexpr std::int64_t kEmbeddingChannels = 8;
constexpr std::int64_t kPlaneChannels = 32;
constexpr std::int64_t kDecoderHidden = 32;

// Input of the geometry decoder: scaled position (3), then the embedding (8); output SDF / truncation.
constexpr MlpShape kGeometryDecoder{3 + kEmbeddingChannels, kDecoderHidden, 1, MlpActivation::kTanh};
constexpr MlpShape kColorDecoder{kPlaneChannels, kDecoderHidden, 3, MlpActivation::kSigmoid};

// Pointers to device memory of the kernel's device; nothing is owned.
struct SceneView {
  VoxelTable table;
  const std::int32_t* corner_ids;  // [num_voxels, 8]
  std::int64_t num_voxels;
  const float* embeddings;       // [num_voxels, 8]
  const float* geometry_params;  // flat, kGeometryDecoder
  const float* texels;           // [rows, 32]
  const float* color_params;     // flat, kColorDecoder
  float voxel_size;              // m
  float origin[3];               // world point that decoder positions are relative to, m
  float position_scale;          // 1/m
  float plane_cell_size;         // m
  TriPlaneLayout planes;
};

}  // namespace spslam
