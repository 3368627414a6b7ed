#include "spslam/scene_query.h"

#include "core/parallel.h"
#include "cpu/scene_tile.h"
#include "kernels/interpolation.h"
#include "kernels/voxel_hash.h"

namespace spslam {
namespace {

constexpr std::int64_t kQueryGrain = 16 * kTileRows;

Vec3<float> load_point(const float* points, std::int64_t i) {
  return {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
}

// Decodes the tile's points into their rows of the output, and empties the tile.
void flush(const SceneView& scene, GeometryTile& tile, const std::int64_t* rows, float* sdf, float* gradient) {
  float values[kTileRows];
  Vec3<float> slopes[kTileRows];
  tile.decode(values);
  if (gradient) tile.position_gradient(scene, slopes);
  for (std::int64_t i = 0; i < tile.size(); ++i) {
    sdf[rows[i]] = values[i];
    if (!gradient) continue;
    float* g = gradient + 3 * rows[i];
    g[0] = slopes[i].x, g[1] = slopes[i].y, g[2] = slopes[i].z;
  }
  tile.clear();
}

}  // namespace

template <>
void query_sdf<Cpu>(Cpu, const SceneView& scene, const float* points, std::int64_t n, float* sdf, bool* valid,
                    float* gradient) {
  const PackedMlp<float> net(kGeometryDecoder, scene.geometry_params);
  const float inverse_voxel = 1.0f / scene.voxel_size;
  parallel_for(n, kQueryGrain, [&](std::int64_t begin, std::int64_t end) {
    GeometryTile tile(net);
    std::int64_t rows[kTileRows];
    for (std::int64_t i = begin; i < end; ++i) {
      const Vec3<float> point = load_point(points, i);
      const Cell<float> cell = find_cell(scene.table, scene.corner_ids, scene.num_voxels, inverse_voxel * point);
      valid[i] = cell.corner_ids != nullptr;
      sdf[i] = 1.0f;
      if (gradient) gradient[3 * i] = gradient[3 * i + 1] = gradient[3 * i + 2] = 0.0f;
      if (!valid[i]) continue;
      rows[tile.size()] = i;
      tile.add(scene, point, cell);
      if (tile.full()) flush(scene, tile, rows, sdf, gradient);
    }
    if (tile.size()) flush(scene, tile, rows, sdf, gradient);
  });
}

template <>
void query_color<Cpu>(Cpu, const SceneView& scene, const float* points, std::int64_t n, float* color) {
  const PackedMlp<float> net(kColorDecoder, scene.color_params);
  const float inverse_cell = 1.0f / scene.plane_cell_size;
  parallel_for(n, kQueryGrain, [&](std::int64_t begin, std::int64_t end) {
    ScratchBuffer<float> buffers[3];
    float* x = buffers[0].reserve(kTileRows * net.layout.input_stride);
    float* h1 = buffers[1].reserve(kTileRows * net.layout.hidden_stride);
    float* h2 = buffers[2].reserve(kTileRows * net.layout.hidden_stride);
    float out[3 * kTileRows];
    for (std::int64_t first = begin; first < end; first += kTileRows) {
      const std::int64_t count = end - first < kTileRows ? end - first : kTileRows;
      for (std::int64_t i = 0; i < round_up(count, kRowBlock) * net.layout.input_stride; ++i) x[i] = 0.0f;
      for (std::int64_t i = 0; i < count; ++i) {
        const Vec3<float> point = load_point(points, first + i);
        float* feature = x + i * net.layout.input_stride;
        for (int plane = 0; plane < 3; ++plane) {
          if (empty_plane(scene.planes.planes[plane])) continue;
          const PlaneCell<float> cell = tri_plane_cell(point, inverse_cell, scene.planes.planes[plane], plane);
          for (int k = 0; k < 4; ++k) {
            const float* row = scene.texels + kPlaneChannels * cell.rows[k];
            for (std::int64_t c = 0; c < kPlaneChannels; ++c) feature[c] += cell.weights[k] * row[c];
          }
        }
      }
      mlp_tile_forward(net, round_up(count, kRowBlock), x, h1, h2, out, kTileRows);
      for (std::int64_t i = 0; i < count; ++i) {
        for (int k = 0; k < 3; ++k) {
          color[3 * (first + i) + k] = activate(MlpActivation::kSigmoid, out[k * kTileRows + i]);
        }
      }
    }
  });
}

}  // namespace spslam
