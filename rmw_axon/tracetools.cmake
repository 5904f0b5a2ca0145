# The tracepoints of ros2_tracing. They are optional: without tracetools, or with one that was built without
# tracepoints (TRACETOOLS_DISABLED), rmw_axon is built without them. Its header differs between the
# distributions, so tests compile against it.

include(CheckCXXSourceCompiles)

# Whether `statement` compiles with tracetools' header.
macro(axon_tracetools_has variable statement)
  check_cxx_source_compiles("
    #include <tracetools/tracetools.h>
    void check() {${statement}}
  " ${variable})
endmacro()

function(axon_add_tracepoints target)
  find_package(tracetools QUIET)
  if(NOT TARGET tracetools::tracetools)
    message(STATUS "Tracepoints: none, there is no tracetools")
    return()
  endif()
  # Compiling is enough, and a machine that is built for needs no linker here.
  set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY)
  set(CMAKE_REQUIRED_LIBRARIES tracetools::tracetools)
  set(CMAKE_REQUIRED_QUIET ON)
  # Results of another tracetools do not count.
  if(NOT "${AXON_TRACETOOLS_ASKED}" STREQUAL "${tracetools_DIR} ${tracetools_VERSION}")
    foreach(variable AXON_TRACE AXON_TRACE_TIMESTAMP AXON_TRACE_SERVICES)
      unset(${variable} CACHE)
    endforeach()
    set(AXON_TRACETOOLS_ASKED "${tracetools_DIR} ${tracetools_VERSION}" CACHE INTERNAL "")
  endif()
  axon_tracetools_has(AXON_TRACE
    "ros_trace_rmw_publisher_init(nullptr, nullptr); ros_trace_rmw_take(nullptr, nullptr, 0, false);")
  if(NOT AXON_TRACE)
    message(STATUS "Tracepoints: none, tracetools ${tracetools_VERSION} has none of rmw")
    return()
  endif()
  # From Jazzy on: the publisher and the source timestamp, beside the message.
  axon_tracetools_has(AXON_TRACE_TIMESTAMP "ros_trace_do_rmw_publish(nullptr, nullptr, int64_t{});")
  # From Kilted on.
  axon_tracetools_has(AXON_TRACE_SERVICES
    "ros_trace_rmw_client_init(nullptr, nullptr);
     ros_trace_rmw_send_request(nullptr, nullptr, int64_t{});
     ros_trace_rmw_take_request(nullptr, nullptr, nullptr, int64_t{}, false);
     ros_trace_do_rmw_send_response(nullptr, nullptr, nullptr, int64_t{}, int64_t{});
     ros_trace_rmw_take_response(nullptr, nullptr, int64_t{}, int64_t{}, false);")
  set(parts "topics")
  target_compile_definitions(${target} PRIVATE AXON_TRACE=1)
  if(AXON_TRACE_TIMESTAMP)
    string(APPEND parts ", with timestamps")
    target_compile_definitions(${target} PRIVATE AXON_TRACE_TIMESTAMP=1)
  endif()
  if(AXON_TRACE_SERVICES)
    string(APPEND parts ", services")
    target_compile_definitions(${target} PRIVATE AXON_TRACE_SERVICES=1)
  endif()
  message(STATUS "Tracepoints: ${parts}, as tracetools ${tracetools_VERSION} has them")
  target_link_libraries(${target} PRIVATE tracetools::tracetools)
endfunction()
