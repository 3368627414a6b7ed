#include "spslam/pixel_sampling.h"

#include <algorithm>

#include "core/parallel.h"
#include "cpu/depth_normals.h"
#include "kernels/pixel_sampling.h"
#include "launch/pixel_sampling.h"

namespace spslam {
namespace {

constexpr std::int32_t kRows = 32;                 // of a chunk where several threads share a frame
constexpr std::int64_t kDrawn = 64 * kPixelBatch;  // pixels of a chunk

// Kept by each thread that samples frames: allocating pages for every frame takes as long as the sampling.
struct FrameScratch {
  ScratchBuffer<float> depth;
  ScratchBuffer<std::int32_t> valid;
  ScratchBuffer<std::int64_t> counts;
};
thread_local FrameScratch scratch;

// Rows [begin, end) of a frame: copies usable depth into the padded image, the rest as 0, and lists the indices of
// usable pixels. There must be room for one more: an entry is written before its pixel is known to be valid.
std::int64_t list_valid(const RgbdImage& image, const PixelSampling& sampling, PaddedDepth& depth, std::int32_t begin,
                        std::int32_t end, std::int32_t* valid) {
  const float low = sampling.min_depth, high = sampling.max_depth;
  std::int64_t count = 0;
  for (std::int32_t v = begin; v < end; ++v) {
    const float* from = image.depth + static_cast<std::int64_t>(v) * image.width;
    float* to = depth.row(v);
    SPS_SIMD for (std::int32_t u = 0; u < image.width; ++u) to[u] = usable_depth(from[u], low, high);
    const std::int32_t first = v * image.width;
    for (std::int32_t u = 0; u < image.width; ++u) {
      valid[count] = first + u;
      count += to[u] > 0.0f;
    }
  }
  return count;
}

void write_thumbnail(const RgbdImage& image, std::int32_t step, PaddedDepth& depth, std::uint16_t* depth_thumbnail) {
  for (std::int32_t v = step / 2; v < image.height; v += step) {
    const float* row = depth.row(v);
    for (std::int32_t u = step / 2; u < image.width; u += step) *depth_thumbnail++ = half_bits(row[u]);
  }
}

// Of the rows [begin, end) of a frame those that depth and intensity image have.
void write_images(const RgbdImage& image, const PixelSampling& sampling, PaddedDepth& depth, std::int32_t begin,
                  std::int32_t end, const SampledPixels& out) {
  const std::int32_t step = sampling.depth_image_step;
  if (step == 0) return;
  const float per_unit = 1.0f / sampling.depth_image_unit;
  const std::int32_t columns = depth_image_size(image.width, step);
  for (std::int32_t r = (begin + step - 1) / step; r * step < end; ++r) {
    const float* depths = depth.row(r * step);
    std::uint16_t* depth_image = out.depth_image + static_cast<std::int64_t>(r) * columns;
    SPS_SIMD for (std::int32_t c = 0; c < columns; ++c) depth_image[c] = depth_image_number(depths[c * step], per_unit);
    const std::uint8_t* colors = image.color + 3 * static_cast<std::int64_t>(r * step) * image.width;
    std::uint8_t* intensity_image = out.intensity_image + static_cast<std::int64_t>(r) * columns;
    SPS_SIMD for (std::int32_t c = 0; c < columns; ++c) intensity_image[c] = rounded_luma(colors + 3 * c * step);
  }
}

// Draws pixels [first, first + n) of the frame.
void draw_batch(const RgbdImage& image, PaddedDepth& depth, const std::int32_t* valid, std::int64_t num_valid,
                PhiloxKey key, const PixelSampling& sampling, std::int64_t first, int n, const SampledPixels& out) {
  const std::int32_t* drawn[kPixelBatch];
  std::int32_t u[kPixelBatch], v[kPixelBatch];
  for (int i = 0; i < n; ++i) {
    drawn[i] = valid + philox_index(key, static_cast<std::uint32_t>(first + i), num_valid);
    __builtin_prefetch(drawn[i]);
  }
  for (int i = 0; i < n; ++i) {
    const std::int32_t place = *drawn[i];
    v[i] = place / image.width;
    u[i] = place - v[i] * image.width;
    __builtin_prefetch(image.color + 3 * static_cast<std::int64_t>(place));
  }
  const DepthImage whole{image.depth, image.width, image.height, camera_of(image)};
  float* normals = out.normals + 3 * first;
  normals_of_batch(whole, depth, u, v, n, sampling.step_px, sampling.max_jump, normals);
  for (int i = 0; i < n; ++i) {
    write_record(image, u[i], v[i], depth.row(v[i])[u[i]], normals + 3 * i, out.records + kPixelWords * (first + i));
  }
}

}  // namespace

template <>
std::int64_t sample_pixels_workspace_bytes<Cpu>(Cpu, std::int32_t, std::int32_t) {
  return 0;
}

template <>
std::int64_t sample_pixels<Cpu>(Cpu, const RgbdImage& image, PhiloxKey key, const PixelSampling& sampling, void*,
                                const SampledPixels& out) {
  PaddedDepth depth(image.width, image.height);
  depth.allocate(scratch.depth);
  // Each chunk lists its own pixels, with room for one more; together they make the list, that of a single one at once.
  const std::int32_t rows = sampling.shared ? kRows : std::max(image.height, 1);
  const std::int64_t chunks = chunk_count(image.height, rows), room = static_cast<std::int64_t>(rows) * image.width + 1;
  std::int32_t* valid = scratch.valid.reserve(chunks * room);
  std::int64_t* counts = scratch.counts.reserve(chunks);
  parallel_chunks(image.height, rows, [&](std::int64_t chunk, std::int64_t begin, std::int64_t end) {
    const std::int32_t first = static_cast<std::int32_t>(begin), last = static_cast<std::int32_t>(end);
    counts[chunk] = list_valid(image, sampling, depth, first, last, valid + chunk * room);
    write_images(image, sampling, depth, first, last, out);
  });
  std::int64_t num_valid = chunks > 0 ? counts[0] : 0;
  for (std::int64_t chunk = 1; chunk < chunks; num_valid += counts[chunk++]) {
    std::copy_n(valid + chunk * room, counts[chunk], valid + num_valid);
  }
  write_thumbnail(image, sampling.thumbnail_step, depth, out.depth_thumbnail);
  if (num_valid == 0) {
    std::fill(out.records, out.records + kPixelWords * sampling.count, 0);
    std::fill(out.normals, out.normals + 3 * sampling.count, 0.0f);
    return 0;
  }
  parallel_for(sampling.count, sampling.shared ? kDrawn : std::max<std::int64_t>(sampling.count, 1),
               [&](std::int64_t begin, std::int64_t end) {
                 for (std::int64_t first = begin; first < end; first += kPixelBatch) {
                   const int n = static_cast<int>(std::min<std::int64_t>(kPixelBatch, end - first));
                   draw_batch(image, depth, valid, num_valid, key, sampling, first, n, out);
                 }
               });
  return num_valid;
}

SPS_INSTANTIATE_PIXEL_SAMPLING(Cpu)

}  // namespace spslam
