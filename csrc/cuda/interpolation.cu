#include "core/fixed_point.cuh"
#include "core/for_each.h"
#include "launch/interpolation.h"

namespace spslam {
namespace {

// Threads that share one point, each taking every eighth channel: rows are read in full 32-byte sectors.
constexpr std::int64_t kLanes = 8;

// Sum over the lanes of one point, in a fixed order. The lanes of a point are always active together.
template <class T>
__device__ T sum_lanes(T value) {
  const unsigned lanes = 0xffu << (threadIdx.x % 32 / kLanes * kLanes);
  for (int offset = kLanes / 2; offset; offset /= 2) value += __shfl_xor_sync(lanes, value, offset);
  return value;
}

}  // namespace

template <>
struct InterpolationLoops<Cuda> {
  template <class T>
  static void fill_zero(Cuda device, std::int64_t count, T* out) {
    if (count > 0) cudaMemsetAsync(out, 0, count * sizeof(T), static_cast<cudaStream_t>(device.stream));
  }

  template <class Field, class T>
  static void gather(Cuda device, const Field& field, const T* table, std::int64_t channels, std::int64_t num_points,
                     T* out) {
    for_each(device, num_points * kLanes, [=] __device__(std::int64_t i) {
      const std::int64_t n = i / kLanes;
      typename Field::Stencil stencil;
      const bool valid = field.load(n, stencil);
      for (std::int64_t c = i % kLanes; c < channels; c += kLanes) {
        T sum = 0;
        if (valid) {
          for (int k = 0; k < Field::kRows; ++k) sum += stencil.weights[k] * table[stencil.rows[k] * channels + c];
        }
        out[n * channels + c] = sum;
      }
    });
  }

  template <class Field, class T>
  static void gather_gradient(Cuda device, const Field& field, const T* grad, const T* table, std::int64_t channels,
                              std::int64_t num_points, T* out) {
    for_each(device, num_points * kLanes, [=] __device__(std::int64_t i) {
      const std::int64_t n = i / kLanes;
      typename Field::Stencil stencil;
      Vec3<T> sum{0, 0, 0};
      if (field.load(n, stencil)) {
        for (std::int64_t c = i % kLanes; c < channels; c += kLanes) {
          T values[Field::kRows];
          for (int k = 0; k < Field::kRows; ++k) values[k] = table[stencil.rows[k] * channels + c];
          sum = sum + grad[n * channels + c] * stencil.gradient(values);
        }
      }
      const T coords[3] = {sum_lanes(sum.x), sum_lanes(sum.y), sum_lanes(sum.z)};
      if (i % kLanes == 0) {
        for (int axis = 0; axis < Field::kAxes; ++axis) out[n * Field::kAxes + axis] = coords[axis];
      }
    });
  }

  template <class Field, class T>
  static void scatter(Cuda device, const Field& field, const T* grad, std::int64_t num_rows, std::int64_t channels,
                      std::int64_t num_points, T* out, std::int64_t* workspace) {
    const std::int64_t size = num_rows * channels;
    std::int64_t* const sums = workspace;
    std::int64_t* const largest = workspace + size;
    fill_zero(device, size + 1, workspace);
    // Of points that have a value: the gradient of another, which may be no number, goes nowhere.
    max_abs_of(
        device, num_points * channels,
        [=] __device__(std::int64_t i) {
          typename Field::Stencil stencil;
          return field.load(i / channels, stencil) ? grad[i] : T(0);
        },
        largest);
    for_each(device, num_points * kLanes, [=] __device__(std::int64_t i) {
      const std::int64_t n = i / kLanes;
      typename Field::Stencil stencil;
      if (!field.load(n, stencil)) return;
      const FixedPoint fixed(largest, num_points * Field::kRows);
      for (std::int64_t c = i % kLanes; c < channels; c += kLanes) {
        const double g = grad[n * channels + c];
        for (int k = 0; k < Field::kRows; ++k) fixed.add(sums + stencil.rows[k] * channels + c, stencil.weights[k] * g);
      }
    });
    for_each(device, size, [=] __device__(std::int64_t i) {
      const FixedPoint fixed(largest, num_points * Field::kRows);
      out[i] = static_cast<T>(fixed.value(sums[i]));
    });
  }
};

template <>
std::int64_t scatter_workspace_words<Cuda>(std::int64_t table_size) {
  return table_size + 1;
}

SPS_INSTANTIATE_INTERPOLATION(Cuda, float)
SPS_INSTANTIATE_INTERPOLATION(Cuda, double)
}  // namespace spslam
