# The headers as they are installed, put together in SPSLAM_INCLUDE_DIR of the build tree: the public ones below
# spslam/, beside them core/, which they include, and version.h. In the sources core/ is named from csrc; here every
# name begins with spslam/, so that a project that uses add_subdirectory includes the same as one that finds it
# installed.
set(SPSLAM_INCLUDE_DIR ${CMAKE_CURRENT_BINARY_DIR}/include)
set(_csrc ${CMAKE_CURRENT_SOURCE_DIR}/csrc)

file(GLOB_RECURSE _public CONFIGURE_DEPENDS RELATIVE ${_csrc}/include ${_csrc}/include/spslam/*.h)
file(GLOB _inner CONFIGURE_DEPENDS RELATIVE ${_csrc} ${_csrc}/core/*.h)
file(GLOB_RECURSE _stale RELATIVE ${SPSLAM_INCLUDE_DIR} ${SPSLAM_INCLUDE_DIR}/*.h)

# Writes where the text is another, so that nothing is compiled anew for nothing; again where the header is changed.
function(spslam_stage_header from to)
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS ${from})
  file(READ ${from} text)
  string(REGEX REPLACE "#include \"core/" "#include \"spslam/core/" text "${text}")
  set(before "")
  if(EXISTS ${SPSLAM_INCLUDE_DIR}/${to})
    file(READ ${SPSLAM_INCLUDE_DIR}/${to} before)
  endif()
  if(NOT text STREQUAL before)
    file(WRITE ${SPSLAM_INCLUDE_DIR}/${to} "${text}")
  endif()
endfunction()

foreach(_header IN LISTS _public)
  spslam_stage_header(${_csrc}/include/${_header} ${_header})
endforeach()
foreach(_header IN LISTS _inner)
  spslam_stage_header(${_csrc}/${_header} spslam/${_header})
endforeach()
configure_file(${CMAKE_CURRENT_LIST_DIR}/version.h.in ${SPSLAM_INCLUDE_DIR}/spslam/version.h @ONLY)

list(TRANSFORM _inner PREPEND spslam/)
list(REMOVE_ITEM _stale ${_public} ${_inner} spslam/version.h)
foreach(_header IN LISTS _stale)
  file(REMOVE ${SPSLAM_INCLUDE_DIR}/${_header})
endforeach()
