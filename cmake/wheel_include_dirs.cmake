# SPDX-License-Identifier: Apache-2.0
#
# The ROS 2 wheels export include directories of the machine that built them
# (/opt/python/cpXY-cpXY/...), and CMake refuses a target whose include
# directory is missing. Given as CMAKE_PROJECT_INCLUDE, this file drops those
# entries at the end of configuring and leaves the wheels as they are.
# Needs CMake 3.21 (IMPORTED_TARGETS).

function(drop_missing_wheel_include_dirs)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(directories ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT directories)
      continue()
    endif()
    set(kept "")
    foreach(directory IN LISTS directories)
      if(NOT directory MATCHES "^/opt/python/" OR EXISTS "${directory}")
        list(APPEND kept "${directory}")
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${kept}")
  endforeach()
endfunction()

cmake_language(DEFER CALL drop_missing_wheel_include_dirs)
