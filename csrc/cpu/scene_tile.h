// The scene at a tile of points: features gathered and decoded, and gradients by position.
#pragma once

#include <cstdint>

#include "cpu/mlp_tile.h"
#include "kernels/decoders.h"
#include "kernels/interpolation.h"
#include "kernels/voxel_hash.h"
#include "spslam/scene_view.h"

namespace spslam {

using EmbeddingVector = Vector<float, static_cast<int>(kEmbeddingChannels * sizeof(float))>;

// Geometry of up to kTileRows points that lie in complete cells.
class GeometryTile {
 public:
  explicit GeometryTile(const PackedMlp<float>& net)
      : net_(net),
        x_(buffers_[0].reserve(kTileRows * net.layout.input_stride)),
        grad_x_(buffers_[1].reserve(kTileRows * net.layout.input_stride)),
        h1_(buffers_[2].reserve(kTileRows * net.layout.hidden_stride)),
        h2_(buffers_[3].reserve(kTileRows * net.layout.hidden_stride)),
        g1_(buffers_[4].reserve(kTileRows * net.layout.hidden_stride)),
        g2_(buffers_[5].reserve(kTileRows * net.layout.hidden_stride)) {
    for (std::int64_t i = 0; i < kTileRows * net.layout.input_stride; ++i) x_[i] = 0.0f;
  }

  std::int64_t size() const { return size_; }
  bool full() const { return size_ == kTileRows; }
  void clear() { size_ = 0; }

  // Adds a point (m) in a cell found by find_cell.
  void add(const SceneView& scene, const Vec3<float>& point, const Cell<float>& cell) {
    cells_[size_] = cell;
    EmbeddingVector feature{};
    for (int k = 0; k < kCellCorners; ++k) {
      const float* row = scene.embeddings + kEmbeddingChannels * static_cast<std::int64_t>(cell.corner_ids[k]);
      feature += trilinear_weight(cell.local, k) * load_vector<EmbeddingVector>(row);
    }
    float* x = x_ + size_ * net_.layout.input_stride;
    x[0] = (point.x - scene.origin[0]) * scene.position_scale;
    x[1] = (point.y - scene.origin[1]) * scene.position_scale;
    x[2] = (point.z - scene.origin[2]) * scene.position_scale;
    store_vector(x + 3, feature);
    ++size_;
  }

  // sdf[i] of every point.
  void decode(float* sdf) {
    const std::int64_t rows = round_up(size_, kRowBlock);
    mlp_tile_forward(net_, rows, x_, h1_, h2_, sdf_, kTileRows);
    for (std::int64_t i = 0; i < size_; ++i) sdf[i] = sdf_[i] = activate(MlpActivation::kTanh, sdf_[i]);
  }

  // gradient[i] = d sdf / d point (1/m), after decode().
  void position_gradient(const SceneView& scene, Vec3<float>* gradient) {
    const std::int64_t rows = round_up(size_, kRowBlock);
    for (std::int64_t i = 0; i < rows; ++i) sdf_[i] = i < size_ ? 1.0f - sdf_[i] * sdf_[i] : 0.0f;
    mlp_tile_backward(net_, rows, h1_, h2_, sdf_, kTileRows, g1_, g2_, grad_x_);
    const float inverse_voxel = 1.0f / scene.voxel_size;
    for (std::int64_t i = 0; i < size_; ++i) {
      const float* g = grad_x_ + i * net_.layout.input_stride;
      const EmbeddingVector feature_gradient = load_vector<EmbeddingVector>(g + 3);
      float corner[kCellCorners];
      for (int k = 0; k < kCellCorners; ++k) {
        const float* row = scene.embeddings + kEmbeddingChannels * static_cast<std::int64_t>(cells_[i].corner_ids[k]);
        corner[k] = sum_lanes<float, sizeof(EmbeddingVector)>(feature_gradient * load_vector<EmbeddingVector>(row));
      }
      gradient[i] = scene.position_scale * Vec3<float>{g[0], g[1], g[2]} +
                    inverse_voxel * trilinear_gradient(cells_[i].local, corner);
    }
  }

 private:
  const PackedMlp<float>& net_;
  ScratchBuffer<float> buffers_[6];
  float *x_, *grad_x_, *h1_, *h2_, *g1_, *g2_;
  float sdf_[kTileRows];
  Cell<float> cells_[kTileRows];
  std::int64_t size_ = 0;
};

}  // namespace spslam
