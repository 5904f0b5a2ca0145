# Warns where this package is configured for a ROS distribution that it was not tested with. The versions of rmw and
# rosidl tell: ROS_DISTRO is not set by every installation.

# Distribution, rmw, rosidl
set(axon_tested_distributions "Humble 6.1 3.1" "Jazzy 7.3 4.6" "Rolling 7.10 5.3")

function(axon_warn_of_distribution rmw rosidl)
  set(names "")
  foreach(tested IN LISTS axon_tested_distributions)
    separate_arguments(tested)
    list(GET tested 0 name)
    list(GET tested 1 tested_rmw)
    list(GET tested 2 tested_rosidl)
    # 7.3 is 7.3.1 and not 7.30.
    string(FIND "${rmw}." "${tested_rmw}." rmw_at)
    string(FIND "${rosidl}." "${tested_rosidl}." rosidl_at)
    if(rmw_at EQUAL 0 AND rosidl_at EQUAL 0)
      return()
    endif()
    list(APPEND names "${name} (rmw ${tested_rmw}, rosidl ${tested_rosidl})")
  endforeach()
  list(JOIN names ", " names)
  message(WARNING
    "rmw_axon was never tested with this distribution (rmw ${rmw}, rosidl ${rosidl}). "
    "It was tested with ${names}. Messages may be laid out in memory in another way here. "
    "Run `colcon test --packages-select rmw_axon` before you use it.")
endfunction()
