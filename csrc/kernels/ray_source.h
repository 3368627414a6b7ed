// The slot, row and pixel record of each ray of a step.
#pragma once

#include <cstdint>

#include "core/macros.h"
#include "core/philox.h"
#include "kernels/pixel_record.h"
#include "spslam/types/ray_source.h"

namespace spslam {

SPS_INLINE std::int64_t ray_slot(const RaySource& source, std::int64_t ray) {
  return source.ray_slots ? source.ray_slots[ray] : ray * source.num_slots / source.num_rays;
}

SPS_INLINE std::int64_t slot_row(const RaySource& source, std::int64_t slot) {
  return source.slot_rows ? source.slot_rows[slot] : slot;
}

SPS_INLINE const std::int32_t* ray_record(const RaySource& source, std::int64_t ray, std::int64_t row) {
  if (source.records_per_row == 0) return source.records + kPixelWords * ray;
  const std::int64_t drawn =
      philox_index(source.draw, static_cast<std::uint32_t>(ray), static_cast<std::uint64_t>(source.records_per_row));
  return source.records + kPixelWords * (row * source.records_per_row + drawn);
}

// The first ray of a slot or of one after it.
SPS_INLINE std::int64_t first_ray_of_slot(const RaySource& source, std::int64_t slot) {
  if (!source.ray_slots) return (slot * source.num_rays + source.num_slots - 1) / source.num_slots;
  std::int64_t low = 0, high = source.num_rays;
  while (low < high) {
    const std::int64_t middle = (low + high) / 2;
    if (source.ray_slots[middle] < slot) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

}  // namespace spslam
