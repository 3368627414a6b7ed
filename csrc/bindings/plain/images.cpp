// Plain C functions that Python calls by ctypes: the data is looked at while torch is loaded, so they need none.
#include <new>

#include "bindings/plain/export.h"
#include "core/parallel.h"
#include "spslam/color_registration.h"
#include "spslam/png_filters.h"

// Whether this processor has the instructions that the kernels are compiled for; this file is compiled for any.
SPS_EXPORT int spslam_runs_here() {
#if defined(SPSLAM_NEEDS_AVX512)
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#elif defined(SPSLAM_NEEDS_AVX2)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#else
  return 1;
#endif
}

// Threads that share one image, the calling one included; these functions have a pool of their own.
SPS_EXPORT void spslam_set_threads(int count) {
  spslam::set_num_threads(count);
}

// colors and registered_colors: null where only depth is wanted. sizes: of the color image, the depth image and the
// depth buffer, width and height each. numbers: those of a `PixelMap` in its order, the typical depth and the hidden
// share. Returns 0, or 1 where there is not enough memory.
SPS_EXPORT int spslam_register_color(const std::uint8_t* colors, const std::uint8_t* unseen, const float* depth,
                                     const std::int32_t* sizes, const float* numbers, std::uint8_t* registered_colors,
                                     float* registered_depth) {
  spslam::ColorRegistration registration{};
  for (int k = 0; k < 3; ++k) {
    registration.map.by_u[k] = numbers[k];
    registration.map.by_v[k] = numbers[3 + k];
    registration.map.constant[k] = numbers[6 + k];
    registration.map.offset[k] = numbers[9 + k];
  }
  registration.typical_depth = numbers[12];
  registration.hidden_share = numbers[13];
  registration.color_width = sizes[0], registration.color_height = sizes[1];
  registration.width = sizes[2], registration.height = sizes[3];
  registration.cells_wide = sizes[4], registration.cells_high = sizes[5];
  try {
    spslam::register_color(spslam::Cpu{}, registration, {colors, unseen, depth}, registered_colors, registered_depth);
  } catch (const std::bad_alloc&) {
    return 1;
  }
  return 0;
}

// sizes: rows, bytes of a row without its filter's number, bytes of a pixel. Of numbers of 16 bits the bytes are
// exchanged. Returns 0, 1 where there is not enough memory, 2 where a row's filter is none.
SPS_EXPORT int spslam_unfilter_png(const std::uint8_t* filtered, const std::int32_t* sizes, int is_16_bit,
                                   std::uint8_t* out) {
  const spslam::PngRows image{sizes[0], sizes[1], sizes[2]};
  try {
    if (!spslam::unfilter_png(spslam::Cpu{}, image, filtered, out)) return 2;
  } catch (const std::bad_alloc&) {
    return 1;
  }
  if (is_16_bit) {
    spslam::swap_bytes(spslam::Cpu{}, image.rows * image.row_bytes / 2, reinterpret_cast<std::uint16_t*>(out));
  }
  return 0;
}
