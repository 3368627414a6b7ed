// How plain C functions are found by name in a library whose other symbols are hidden.
#pragma once

#define SPS_EXPORT extern "C" __attribute__((visibility("default")))
