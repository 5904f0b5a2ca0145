// SPDX-License-Identifier: MIT OR Apache-2.0

#include "features.hpp"

#include "rmw/features.h"

extern "C" {

bool rmw_feature_supported(rmw_feature_t feature)
{
  switch (feature) {
    // Publication counts every publish; reception counts at take.
    case RMW_FEATURE_MESSAGE_INFO_PUBLICATION_SEQUENCE_NUMBER:
    case RMW_FEATURE_MESSAGE_INFO_RECEPTION_SEQUENCE_NUMBER:
      return true;
    default:
      return false;
  }
}

}
