# A distribution that was never tested is warned of, by name of those that were: cmake -P test/distribution.cmake
cmake_minimum_required(VERSION 3.16)
include(${CMAKE_CURRENT_LIST_DIR}/../distribution.cmake)

if(DEFINED RMW)
  axon_warn_of_distribution("${RMW}" "${ROSIDL}")
  return()
endif()

function(expect_warning expected rmw rosidl)
  execute_process(
    COMMAND ${CMAKE_COMMAND} -DRMW=${rmw} -DROSIDL=${rosidl} -P ${CMAKE_CURRENT_LIST_FILE}
    RESULT_VARIABLE failed ERROR_VARIABLE said)
  string(REGEX REPLACE "[ \n]+" " " said "${said}")
  set(warned FALSE)
  if(said MATCHES "never tested with this distribution \\(rmw ${rmw}, rosidl ${rosidl}\\).*tested with Humble .*, Jazzy .*, Rolling ")
    set(warned TRUE)
  endif()
  if(failed OR NOT warned STREQUAL expected)
    message(SEND_ERROR "rmw ${rmw}, rosidl ${rosidl}: expected a warning: ${expected}; said: ${said}")
  endif()
endfunction()

expect_warning(FALSE 7.3.1 4.6.5)
expect_warning(FALSE 7.3.9 4.6.10)
expect_warning(FALSE 6.1.2 3.1.9)
expect_warning(FALSE 7.10.1 5.3.1)
# Kilted and Lyrical.
expect_warning(TRUE 7.8.2 5.0.0)
expect_warning(TRUE 7.10.1 5.2.1)
expect_warning(TRUE 7.30.0 4.6.5)
expect_warning(TRUE 17.3.0 4.6.5)
expect_warning(TRUE 7.3.1 5.1.4)
expect_warning(TRUE 7.1.0 5.3.1)

# The package's build asks.
file(READ ${CMAKE_CURRENT_LIST_DIR}/../CMakeLists.txt lists)
if(NOT lists MATCHES "\naxon_warn_of_distribution\\(")
  message(SEND_ERROR "CMakeLists.txt does not call axon_warn_of_distribution")
endif()
