# The libraries: torch-free kernels for each instruction set and for CUDA, a torch op library over each, and for each
# instruction set one of plain functions for the reading of images.
include(CheckLanguage)
include(GNUInstallDirs)

# Finds a package once for all folders: what links the kernels may lie in another than this.
function(spslam_find package target)
  if(NOT TARGET ${target})
    find_package(${package} REQUIRED)
    set_target_properties(${target} PROPERTIES IMPORTED_GLOBAL TRUE)
  endif()
endfunction()

spslam_find(Threads Threads::Threads)

if(SPSLAM_CUDA STREQUAL "AUTO")
  check_language(CUDA)
  if(CMAKE_CUDA_COMPILER)
    set(SPSLAM_CUDA ON)
  else()
    set(SPSLAM_CUDA OFF)
  endif()
endif()
if(NOT CMAKE_SYSTEM_PROCESSOR MATCHES "^(x86_64|AMD64)$")
  set(SPSLAM_CPU_ISAS baseline)
endif()
if(Spslam_CPU_ISA)
  set(SPSLAM_DEFAULT_ISA ${Spslam_CPU_ISA})
else()
  list(GET SPSLAM_CPU_ISAS 0 SPSLAM_DEFAULT_ISA)
endif()
message(STATUS "spslam: CPU ${SPSLAM_CPU_ISAS} | CUDA ${SPSLAM_CUDA} | torch ${SPSLAM_TORCH_DIR}")

if(SPSLAM_CUDA)
  # Set before enable_language and before the first target: CMake reads it at both.
  set(CMAKE_CUDA_ARCHITECTURES "${SPSLAM_CUDA_ARCHS}")
  set(CMAKE_CUDA_RUNTIME_LIBRARY Static)
  set(CMAKE_CUDA_STANDARD 17)
  enable_language(CUDA)
  spslam_find(CUDAToolkit CUDA::cudart_static)
endif()

include(SpslamHeaders)
file(GLOB SPSLAM_CPU_SOURCES CONFIGURE_DEPENDS csrc/core/*.cpp csrc/cpu/*.cpp)
file(GLOB SPSLAM_CUDA_SOURCES CONFIGURE_DEPENDS csrc/cuda/*.cu)
file(GLOB SPSLAM_BINDING_SOURCES CONFIGURE_DEPENDS csrc/bindings/*.cpp)
file(GLOB SPSLAM_PLAIN_SOURCES CONFIGURE_DEPENDS csrc/bindings/plain/*.cpp)

# From here the sources are included, by those who link a library what is installed.
function(spslam_source_includes target)
  target_include_directories(${target} PRIVATE ${CMAKE_CURRENT_SOURCE_DIR}/csrc/include
    ${CMAKE_CURRENT_SOURCE_DIR}/csrc)
endfunction()

function(spslam_kernel_includes target)
  spslam_source_includes(${target})
  target_include_directories(${target} INTERFACE $<BUILD_INTERFACE:${SPSLAM_INCLUDE_DIR}>
    $<INSTALL_INTERFACE:${CMAKE_INSTALL_INCLUDEDIR}>)
endfunction()

# Makes a kernel library available as Spslam::<name>, here and, of export set `set`, where it is installed. Within
# another project it is built where that links it.
function(spslam_export target name set)
  add_library(Spslam::${name} ALIAS ${target})
  set_target_properties(${target} PROPERTIES EXPORT_NAME ${name})
  if(SPSLAM_INSTALL)
    install(TARGETS ${target} EXPORT ${set} ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT development)
  else()
    set_target_properties(${target} PROPERTIES EXCLUDE_FROM_ALL TRUE)
  endif()
endfunction()

# Compiles the torch ops as objects `name`, for LibTorch's stable ABI. They check and call: what takes time is in the
# kernels, and half of the time of compiling them was torch's headers and optimizing what wraps an op.
function(spslam_op_objects name)
  add_library(${name} OBJECT ${SPSLAM_BINDING_SOURCES})
  spslam_source_includes(${name})
  target_compile_options(${name} PRIVATE -O1)
  target_precompile_headers(${name} PRIVATE csrc/bindings/common.h)
  target_include_directories(${name} SYSTEM PRIVATE ${SPSLAM_TORCH_DIR}/include)
  target_compile_definitions(${name} PRIVATE TORCH_TARGET_VERSION=${SPSLAM_TORCH_TARGET})
  # Messages name files from here on, not the folders of the machine that built them.
  target_compile_options(${name} PRIVATE -fmacro-prefix-map=${CMAKE_CURRENT_SOURCE_DIR}/=)
endfunction()

# Links `name` as a torch op library of such objects: no Python symbol, no undefined symbol.
function(spslam_op_library name objects)
  add_library(${name} MODULE $<TARGET_OBJECTS:${objects}>)
  set_target_properties(${name} PROPERTIES LINKER_LANGUAGE CXX)
  target_link_options(${name} PRIVATE -Wl,--exclude-libs,ALL)
  if(NOT SPSLAM_SANITIZE)  # the sanitizers' own functions come from the process
    target_link_options(${name} PRIVATE -Wl,-z,defs)
  endif()
  target_link_libraries(${name} PRIVATE ${SPSLAM_TORCH_DIR}/lib/libtorch_cpu.so)
  set_target_properties(${name} PROPERTIES PREFIX "" SKIP_BUILD_RPATH ON)
  install(TARGETS ${name} LIBRARY DESTINATION spslam COMPONENT python)
endfunction()

# Links `name` as a library of plain C functions, for Python without torch; `spslam.ops` alone has no use for it.
function(spslam_plain_library name)
  add_library(${name} MODULE ${SPSLAM_PLAIN_SOURCES})
  spslam_source_includes(${name})
  target_link_options(${name} PRIVATE -Wl,--exclude-libs,ALL)
  set_target_properties(${name} PROPERTIES PREFIX "" SKIP_BUILD_RPATH ON)
  install(TARGETS ${name} LIBRARY DESTINATION spslam COMPONENT images)
endfunction()

if(SPSLAM_SANITIZE)
  add_compile_options(-fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g1)
  add_link_options(-fsanitize=address,undefined)
endif()

set(_isa_flags_baseline "")
set(_isa_needs_avx2 SPSLAM_NEEDS_AVX2)
set(_isa_needs_avx512 SPSLAM_NEEDS_AVX512)
set(_isa_flags_avx2 -march=x86-64-v3)
set(_isa_flags_avx512 -march=x86-64-v4 -mprefer-vector-width=512)
# The ops check and call: instruction sets are the kernels' alone.
if(SPSLAM_TORCH_DIR)
  spslam_op_objects(spslam_cpu_ops)
endif()
foreach(isa IN LISTS SPSLAM_CPU_ISAS)
  set(kernels spslam_cpu_${isa})
  add_library(${kernels} STATIC ${SPSLAM_CPU_SOURCES})
  spslam_kernel_includes(${kernels})
  target_compile_features(${kernels} PUBLIC cxx_std_17)
  target_link_libraries(${kernels} PUBLIC Threads::Threads)
  spslam_export(${kernels} cpu_${isa} SpslamCpuTargets)
  # Vectorized, but with NaN and infinity kept: no -ffast-math.
  target_compile_options(${kernels} PRIVATE -O3 -Wall -Wextra -Wno-psabi -fopenmp-simd -fno-math-errno -fno-trapping-math
    -ffp-contract=fast ${_isa_flags_${isa}})
  if(SPSLAM_TORCH_DIR)
    if(isa STREQUAL "baseline")
      set(suffix cpu)
    else()
      set(suffix cpu_${isa})
    endif()
    spslam_op_library(_ops_${suffix} spslam_cpu_ops)
    target_link_libraries(_ops_${suffix} PRIVATE ${kernels})
    spslam_plain_library(_images_${suffix})
    target_link_libraries(_images_${suffix} PRIVATE ${kernels})
    target_compile_definitions(_images_${suffix} PRIVATE ${_isa_needs_${isa}})
  endif()
endforeach()

# As find_package(Spslam) has it: see SpslamConfig.cmake.in.
if(NOT SPSLAM_DEFAULT_ISA IN_LIST SPSLAM_CPU_ISAS)
  message(FATAL_ERROR "Spslam_CPU_ISA must be one of ${SPSLAM_CPU_ISAS}, got ${SPSLAM_DEFAULT_ISA}")
endif()
add_library(Spslam::cpu ALIAS spslam_cpu_${SPSLAM_DEFAULT_ISA})

if(SPSLAM_CUDA)
  add_library(spslam_cuda STATIC ${SPSLAM_CUDA_SOURCES})
  spslam_kernel_includes(spslam_cuda)
  target_compile_features(spslam_cuda PUBLIC cxx_std_17)
  target_link_libraries(spslam_cuda PUBLIC CUDA::cudart_static)
  spslam_export(spslam_cuda cuda SpslamCudaTargets)
  target_compile_options(spslam_cuda PRIVATE $<$<COMPILE_LANGUAGE:CUDA>:--extended-lambda --expt-relaxed-constexpr>)
  if(SPSLAM_TORCH_DIR)
    spslam_op_objects(spslam_cuda_ops)
    target_link_libraries(spslam_cuda_ops PRIVATE CUDA::cudart_static)
    list(JOIN SPSLAM_CUDA_ARCHS " " arch_names)
    target_compile_definitions(spslam_cuda_ops PRIVATE USE_CUDA SPS_CUDA SPSLAM_CUDA_ARCHS="${arch_names}")
    spslam_op_library(_ops_cuda spslam_cuda_ops)
    if(EXISTS ${SPSLAM_TORCH_DIR}/lib/libtorch_cuda.so)
      set(torch_cuda ${SPSLAM_TORCH_DIR}/lib/libtorch_cuda.so)
    else()
      # A CPU build of torch has the headers but not the library: link against a stand-in of the same SONAME.
      add_library(torch_cuda_stub SHARED cmake/torch_cuda_stub.c)
      set_target_properties(torch_cuda_stub PROPERTIES OUTPUT_NAME torch_cuda C_VISIBILITY_PRESET default)
      set(torch_cuda torch_cuda_stub)
    endif()
    target_link_libraries(_ops_cuda PRIVATE spslam_cuda ${torch_cuda})
  endif()
endif()
