#include "cpu/depth_normals.h"

#include "core/for_each.h"

namespace spslam {

template <>
void depth_normals<Cpu>(Cpu device, const DepthImage& image, const std::int32_t* pixels, std::int64_t n,
                        std::int32_t step_px, float max_jump, float* normals) {
  if (image.width == 0 || image.height == 0) {
    std::fill(normals, normals + 3 * n, 0.0f);
    return;
  }
  constexpr std::int64_t kRowGrain = 32, kPixelGrain = 8 * kPixelBatch;
  ScratchBuffer<float> buffer;
  PaddedDepth depth(image.width, image.height);
  depth.allocate(buffer);
  for_each(
      device, image.height,
      [&](std::int64_t v) {
        const float* from = image.depth + v * image.width;
        float* to = depth.row(static_cast<std::int32_t>(v));
        for (std::int32_t u = 0; u < image.width; ++u) to[u] = valid_depth(from[u]);
      },
      kRowGrain);
  parallel_for(n, kPixelGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t first = begin; first < end; first += kPixelBatch) {
      const int count = static_cast<int>(std::min<std::int64_t>(kPixelBatch, end - first));
      std::int32_t u[kPixelBatch], v[kPixelBatch];
      for (int i = 0; i < count; ++i) {
        u[i] = pixels[2 * (first + i)];
        v[i] = pixels[2 * (first + i) + 1];
      }
      normals_of_batch(image, depth, u, v, count, step_px, max_jump, normals + 3 * first);
    }
  });
}

}  // namespace spslam
