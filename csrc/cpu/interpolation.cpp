#include "launch/interpolation.h"

#include "cpu/interpolation_loops.h"

namespace spslam {

template <>
struct InterpolationLoops<Cpu> {
  template <class T>
  static void fill_zero(Cpu, std::int64_t count, T* out) {
    constexpr std::int64_t kGrain = 1 << 16;
    parallel_for(count, kGrain, [=](std::int64_t begin, std::int64_t end) {
      std::memset(out + begin, 0, static_cast<std::size_t>(end - begin) * sizeof(T));
    });
  }

  template <class Field, class T>
  static void gather(Cpu, const Field& field, const T* table, std::int64_t channels, std::int64_t num_points, T* out) {
    with_channels<8, 16, 32>(channels, [&](auto constant) {
      parallel_for(num_points, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
        gather_points<decltype(constant)::value>(field, table, channels, begin, end, out, channels);
      });
    });
  }

  template <class Field, class T>
  static void gather_gradient(Cpu, const Field& field, const T* grad, const T* table, std::int64_t channels,
                              std::int64_t num_points, T* out) {
    with_channels<8, 16, 32>(channels, [&](auto constant) {
      parallel_for(num_points, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
        gather_gradient_points<decltype(constant)::value>(field, grad, channels, table, channels, begin, end, out);
      });
    });
  }

  // A row is summed in the order of the points, by one thread: threads share the work by parts of the table and by
  // cache lines of its rows. Sharing out the rows themselves was measured and is slower with any number of threads:
  // neighboring points share rows, which are still in the cache when points are taken in order.
  template <class Field, class T>
  static void scatter(Cpu device, const Field& field, const T* grad, std::int64_t num_rows, std::int64_t channels,
                      std::int64_t num_points, T* out, std::int64_t*) {
    fill_zero(device, num_rows * channels, out);
    const std::int64_t width = slice_width<T>(channels, (get_num_threads() + Field::kParts - 1) / Field::kParts);
    const std::int64_t slices = width > 0 ? chunk_count(channels, width) : 0;
    parallel_for(Field::kParts * slices, 1, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t task = begin; task < end; ++task) {
        const std::int64_t first = task % slices * width;
        const std::int64_t count = std::min(width, channels - first);
        with_channels<8, 16, 32>(count, [&](auto constant) {
          scatter_part<decltype(constant)::value>(field, static_cast<int>(task / slices), grad + first, channels,
                                                  channels, count, num_points, out + first);
        });
      }
    });
  }
};

template <>
std::int64_t scatter_workspace_words<Cpu>(std::int64_t) {
  return 0;
}

SPS_INSTANTIATE_INTERPOLATION(Cpu, float)
SPS_INSTANTIATE_INTERPOLATION(Cpu, double)
}  // namespace spslam
