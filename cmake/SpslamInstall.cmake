# What C++ projects need: headers, kernel libraries, the package that find_package(Spslam) reads, and its like for
# pkg-config.
include(CMakePackageConfigHelpers)

set(_package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/Spslam)
set(_pc_dir ${CMAKE_INSTALL_LIBDIR}/pkgconfig)

install(DIRECTORY ${SPSLAM_INCLUDE_DIR}/spslam DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT development)
install(FILES ${CMAKE_CURRENT_SOURCE_DIR}/LICENSE DESTINATION ${CMAKE_INSTALL_DATADIR}/licenses/spslam
  COMPONENT development)

install(EXPORT SpslamCpuTargets NAMESPACE Spslam:: DESTINATION ${_package_dir} COMPONENT development)
if(SPSLAM_CUDA)
  install(EXPORT SpslamCudaTargets NAMESPACE Spslam:: DESTINATION ${_package_dir} COMPONENT development)
endif()

configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/SpslamConfig.cmake.in SpslamConfig.cmake
  INSTALL_DESTINATION ${_package_dir} NO_SET_AND_CHECK_MACRO)
# Before 1.0 a minor version may change the headers.
write_basic_package_version_file(SpslamConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/SpslamConfig.cmake ${CMAKE_CURRENT_BINARY_DIR}/SpslamConfigVersion.cmake
  DESTINATION ${_package_dir} COMPONENT development)

# Found relative to itself, so that a prefix may be moved, or chosen when it is installed.
file(RELATIVE_PATH _prefix_from_pc /${_pc_dir} /)
string(REGEX REPLACE "/$" "" SPSLAM_PREFIX_FROM_PC "${_prefix_from_pc}")
list(JOIN SPSLAM_CPU_ISAS ", " SPSLAM_ISA_NAMES)
configure_file(${CMAKE_CURRENT_LIST_DIR}/spslam.pc.in spslam.pc @ONLY)
install(FILES ${CMAKE_CURRENT_BINARY_DIR}/spslam.pc DESTINATION ${_pc_dir} COMPONENT development)
