// Where the rays of a step come from: a list, or pixels drawn from the records of chosen frames.
#pragma once

#include <cstdint>

#include "core/philox.h"

namespace spslam {

// Each ray belongs to a slot, each slot to a row of poses and of records.
struct RaySource {
  const std::int32_t* records;    // [rows, records_per_row, 3], or [num_rays, 3] where nothing is drawn
  std::int64_t records_per_row;   // a ray's record is drawn from these; 0: ray r takes record r
  PhiloxKey draw;                 // key of the records' draw
  const std::int32_t* ray_slots;  // [num_rays] not decreasing; null: the slots share the rays evenly
  const std::int64_t* slot_rows;  // [num_slots]; null: slot i is row i
  std::int64_t num_rays, num_slots;
  const float* poses;  // [rows, 7]
};

}  // namespace spslam
