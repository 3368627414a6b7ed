#include <thrust/iterator/counting_iterator.h>

#include <cub/device/device_select.cuh>

#include "core/cuda_check.cuh"
#include "kernels/pixel_sampling.h"
#include "launch/pixel_sampling.h"
#include "launch/workspace.h"

namespace spslam {
namespace {

struct IsUsable {
  const float* depth;
  __device__ bool operator()(std::int32_t place) const { return depth[place] > 0.0f; }
};

// Lists the places of usable pixels in order; without scratch memory only finds out how much that takes.
void list_usable(Cuda device, const float* depth, std::int32_t pixels, void* scratch, std::size_t* bytes,
                 std::int32_t* listed, std::int32_t* count) {
  SPS_CUDA_CHECK(cub::DeviceSelect::If(scratch, *bytes, thrust::counting_iterator<std::int32_t>(0), listed, count,
                                       pixels, IsUsable{depth}, static_cast<cudaStream_t>(device.stream)));
}

// The regions of the workspace.
struct Sampled {
  Sampled(Cuda device, void* base, std::int64_t pixels) {
    Workspace space(base);
    depth = space.take<float>(pixels);
    listed = space.take<std::int32_t>(pixels);
    count = space.take<std::int32_t>(1);
    list_usable(device, depth, static_cast<std::int32_t>(pixels), nullptr, &scratch_bytes, listed, count);
    scratch = space.take<char>(static_cast<std::int64_t>(scratch_bytes));
    total_bytes = space.used();
  }
  float* depth;          // usable ones (m), the rest as 0
  std::int32_t* listed;  // places of the usable pixels
  std::int32_t* count;   // how many there are
  std::size_t scratch_bytes = 0;
  void* scratch;
  std::int64_t total_bytes;
};

// Copies usable depth, and writes the three small images.
void write_images(Cuda device, const RgbdImage& image, const PixelSampling& sampling, float* usable,
                  const SampledPixels& out) {
  const std::int32_t step = sampling.depth_image_step, thumbnail_step = sampling.thumbnail_step;
  const std::int32_t columns = depth_image_size(image.width, step), width = image.width;
  const std::int32_t thumbnail_columns = thumbnail_size(width, thumbnail_step);
  const std::int64_t pixels = static_cast<std::int64_t>(width) * image.height;
  const std::int64_t small = static_cast<std::int64_t>(columns) * depth_image_size(image.height, step);
  const std::int64_t thumbnail =
      static_cast<std::int64_t>(thumbnail_columns) * thumbnail_size(image.height, thumbnail_step);
  const float low = sampling.min_depth, high = sampling.max_depth, per_unit = 1.0f / sampling.depth_image_unit;
  for_each(device, pixels, [=] __device__(std::int64_t i) {  // none of the images has more
    usable[i] = usable_depth(image.depth[i], low, high);
    if (i < small) {
      const std::int64_t place = i / columns * step * width + i % columns * step;
      out.depth_image[i] = depth_image_number(usable_depth(image.depth[place], low, high), per_unit);
      out.intensity_image[i] = rounded_luma(image.color + 3 * place);
    }
    if (i < thumbnail) {
      const std::int64_t v = thumbnail_step / 2 + i / thumbnail_columns * thumbnail_step;
      const std::int64_t u = thumbnail_step / 2 + i % thumbnail_columns * thumbnail_step;
      out.depth_thumbnail[i] = half_bits(usable_depth(image.depth[v * width + u], low, high));
    }
  });
}

void draw_pixels(Cuda device, const RgbdImage& image, PhiloxKey key, const PixelSampling& sampling,
                 const Sampled& sampled, const SampledPixels& out) {
  const DepthImage whole{sampled.depth, image.width, image.height, camera_of(image)};
  const std::int32_t *listed = sampled.listed, *count = sampled.count;
  for_each(device, sampling.count, [=] __device__(std::int64_t i) {
    const std::int32_t usable = *count;
    std::int32_t* record = out.records + kPixelWords * i;
    float* normal = out.normals + 3 * i;
    if (usable == 0) {
      for (int k = 0; k < kPixelWords; ++k) record[k] = 0;
      for (int axis = 0; axis < 3; ++axis) normal[axis] = 0.0f;
      return;
    }
    const std::int32_t place = listed[philox_index(key, static_cast<std::uint32_t>(i), usable)];
    const std::int32_t v = place / image.width, u = place - v * image.width;
    const Vec3<float> found = depth_normal(whole, u, v, sampling.step_px, sampling.max_jump);
    normal[0] = found.x;
    normal[1] = found.y;
    normal[2] = found.z;
    write_record(image, u, v, whole.depth[place], normal, record);
  });
}

}  // namespace

template <>
std::int64_t sample_pixels_workspace_bytes<Cuda>(Cuda device, std::int32_t width, std::int32_t height) {
  return Sampled(device, nullptr, static_cast<std::int64_t>(width) * height).total_bytes;
}

template <>
std::int64_t sample_pixels<Cuda>(Cuda device, const RgbdImage& image, PhiloxKey key, const PixelSampling& sampling,
                                 void* workspace, const SampledPixels& out) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const std::int32_t pixels = image.width * image.height;
  const Sampled sampled(device, workspace, pixels);
  write_images(device, image, sampling, sampled.depth, out);
  SPS_CUDA_CHECK(cudaMemsetAsync(sampled.count, 0, sizeof(*sampled.count), stream));  // of an image without pixels
  if (pixels > 0) {
    std::size_t bytes = sampled.scratch_bytes;
    list_usable(device, sampled.depth, pixels, sampled.scratch, &bytes, sampled.listed, sampled.count);
  }
  draw_pixels(device, image, key, sampling, sampled, out);
  std::int32_t usable = 0;
  SPS_CUDA_CHECK(cudaMemcpyAsync(&usable, sampled.count, sizeof(usable), cudaMemcpyDeviceToHost, stream));
  SPS_CUDA_CHECK(cudaStreamSynchronize(stream));
  return usable;
}

SPS_INSTANTIATE_PIXEL_SAMPLING(Cuda)

}  // namespace spslam
