// Last part of render_step on the CPU: gradient rows of samples added to the rows of the tables.
//
// Tables are cut into parts, each of which one thread fills alone by walking through all samples in order: sums have
// one order, whatever the number of threads. Neighbours along a ray mostly share a cell, so a cell's sums stay in
// registers until the cell changes.
#pragma once

#include "cpu/render_step_color.h"

namespace spslam::render {

// Parts of the embeddings: blocks of 64 rows (ids are neighbours where vertices are), dealt out in turn.
constexpr std::int64_t kEmbeddingParts = 4;
constexpr int kEmbeddingBlockShift = 6;
// Parts of a plane: halves of its channels, a cache line each.
constexpr std::int64_t kTexelParts = 2, kTexelPartChannels = kPlaneChannels / kTexelParts;
constexpr std::int64_t kScatterParts = kEmbeddingParts + 3 * kTexelParts;

class EmbeddingScatter {
 public:
  EmbeddingScatter(const SceneView& scene, const RenderGradients& out, std::int64_t part)
      : scene_(scene), out_(out), part_(part) {}

  void add(const TableGradients& tables, std::int64_t begin, std::int64_t end, std::int64_t stride) {
    constexpr std::int64_t kAhead = 16;
    for (std::int64_t i = begin; i < end; ++i) {
      if (i + kAhead < end) prefetch(tables.voxel_of[i + kAhead]);
      if (tables.voxel_of[i] != voxel_) start(tables.voxel_of[i]);
      if (!owned_) continue;
      const Feature grad = load_vector<Feature>(tables.embedding + i * stride + 3);
      for (int k = 0; k < kCellCorners; ++k) sums_[k] += trilinear_weight(tables.local[i], k) * grad;
    }
  }

  // Adds the running cell's sums to its rows. Call once at the end.
  void flush() {
    for (int k = 0; owned_ && k < kCellCorners; ++k) {
      if (!(owned_ >> k & 1)) continue;
      float* row = out_.embeddings + kEmbeddingChannels * std::int64_t{corners_[k]};
      store_vector(row, load_vector<Feature>(row) + sums_[k]);
      if (out_.embedding_stamps) out_.embedding_stamps[corners_[k]] = out_.stamp;
    }
  }

 private:
  void start(std::int32_t voxel) {
    flush();
    voxel_ = voxel;
    owned_ = 0;
    corners_ = scene_.corner_ids + kCellCorners * std::int64_t{voxel};
    for (int k = 0; k < kCellCorners; ++k) {
      owned_ |= static_cast<unsigned>((corners_[k] >> kEmbeddingBlockShift) % kEmbeddingParts == part_) << k;
      sums_[k] = Feature{};
    }
  }

  void prefetch(std::int32_t voxel) const {
    const std::int32_t* corners = scene_.corner_ids + kCellCorners * std::int64_t{voxel};
    for (int k = 0; k < kCellCorners; k += 2) {
      __builtin_prefetch(out_.embeddings + kEmbeddingChannels * std::int64_t{corners[k]}, 1);
    }
  }

  const SceneView& scene_;
  const RenderGradients& out_;
  const std::int64_t part_;
  const std::int32_t* corners_ = nullptr;
  std::int32_t voxel_ = kNoVoxel;
  unsigned owned_ = 0;
  Feature sums_[kCellCorners];
};

class TexelScatter {
 public:
  TexelScatter(const SceneView& scene, const RenderGradients& out, int plane, std::int64_t half)
      : out_(out),
        layout_(scene.planes.planes[plane]),
        plane_(plane),
        first_channel_(half * kTexelPartChannels),
        step_u_(layout_.size_u > 1 ? layout_.size_v : 0),
        step_v_(layout_.size_v > 1 ? 1 : 0) {}

  void add(const TableGradients& tables, std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const PlanePlace& place = tables.places[3 * i + plane_];
      const std::int64_t row = layout_.offset + place.u * layout_.size_v + place.v;
      if (row != row_) start(row);
      const float* grad = tables.texel + i * kPlaneChannels + first_channel_;
      float weights[4];
      bilinear_weights(place.fraction_u, place.fraction_v, weights);
      for (int v = 0; v < kVectors; ++v) {
        const V g = load_vector<V>(grad + v * kLanes<float>);
        for (int k = 0; k < 4; ++k) sums_[k][v] += weights[k] * g;
      }
    }
  }

  // Adds the running cell's sums to its rows. Call once at the end.
  void flush() {
    if (row_ < 0) return;
    for (int k = 0; k < 4; ++k) {
      const std::int64_t row = row_ + (k & 1 ? step_u_ : 0) + (k & 2 ? step_v_ : 0);
      float* texel = out_.texels + row * kPlaneChannels + first_channel_;
      for (int v = 0; v < kVectors; ++v) {
        store_vector(texel + v * kLanes<float>, load_vector<V>(texel + v * kLanes<float>) + sums_[k][v]);
      }
      if (out_.texel_stamps && first_channel_ == 0) out_.texel_stamps[row] = out_.stamp;
    }
  }

 private:
  using V = Vector<float>;
  static constexpr int kVectors = static_cast<int>(kTexelPartChannels) / kLanes<float>;

  void start(std::int64_t row) {
    flush();
    row_ = row;
    for (int k = 0; k < 4; ++k) {
      for (int v = 0; v < kVectors; ++v) sums_[k][v] = V{};
    }
  }

  const RenderGradients& out_;
  const PlaneLayout& layout_;
  const int plane_;
  const std::int64_t first_channel_, step_u_, step_v_;
  std::int64_t row_ = -1;
  V sums_[4][kVectors];
};

// One part of the tables, of kScatterParts.
inline void scatter_part(const SceneView& scene, const RenderGradients& out, const Plan& plan,
                         const TableGradients& tables, std::int64_t chunks, std::int64_t embedding_stride,
                         std::int64_t part) {
  if (part < kEmbeddingParts) {
    if (!plan.embeddings) return;
    EmbeddingScatter scatter(scene, out, part);
    for (std::int64_t c = 0; c < chunks; ++c) {
      const std::int64_t begin = c * tables.capacity;
      scatter.add(tables, begin, begin + tables.num_inside[c], embedding_stride);
    }
    scatter.flush();
  } else if (plan.texels && plan.color && planes_cover(scene.planes)) {
    const std::int64_t texel_part = part - kEmbeddingParts;
    TexelScatter scatter(scene, out, static_cast<int>(texel_part / kTexelParts), texel_part % kTexelParts);
    for (std::int64_t c = 0; c < chunks; ++c) {
      const std::int64_t begin = c * tables.capacity;
      scatter.add(tables, begin, begin + tables.num_colors[c]);
    }
    scatter.flush();
  }
}

}  // namespace spslam::render
