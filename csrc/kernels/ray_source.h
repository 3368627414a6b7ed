// Where the rays of a step come from: a list, or pixels drawn from the records of chosen frames.
#pragma once

#include <cstdint>

#include "core/macros.h"
#include "core/philox.h"
#include "kernels/pixel_record.h"

namespace spslam {

// Each ray belongs to a slot, each slot to a row of poses and of records.
struct RaySource {
  const std::int32_t* records;    // [rows, records_per_row, 3], or [num_rays, 3] where nothing is drawn
  std::int64_t records_per_row;   // a ray's record is drawn from these; 0: record r is ray r's
  PhiloxKey draw;                 // of that
  const std::int32_t* ray_slots;  // [num_rays] not decreasing; null: the slots share the rays evenly
  const std::int64_t* slot_rows;  // [num_slots]; null: slot i is row i
  std::int64_t num_rays, num_slots;
  const float* poses;  // [rows, 7]
};

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
