// SPDX-License-Identifier: MIT OR Apache-2.0

#include "error.hpp"

#include "rmw/error_handling.h"
#include "rmw/rmw.h"

namespace rmw_axon
{

const char * const identifier = "rmw_axon";

void check(axon_ret_t returned)
{
  if (returned == AXON_RET_OK) {
    return;
  }
  rmw_ret_t code = RMW_RET_ERROR;
  switch (returned) {
    case AXON_RET_TIMEOUT:
      code = RMW_RET_TIMEOUT;
      break;
    case AXON_RET_INVALID_ARGUMENT:
    case AXON_RET_INVALID_HANDLE:
      code = RMW_RET_INVALID_ARGUMENT;
      break;
    case AXON_RET_BAD_ALLOC:
      code = RMW_RET_BAD_ALLOC;
      break;
    case AXON_RET_NO_NODE:
      code = RMW_RET_NODE_NAME_NON_EXISTENT;
      break;
    default:
      break;
  }
  const char * text = axon_session_last_error();
  throw Failure(code, text != nullptr ? text : "AXON gave no reason");
}

void require_ours(const char * implementation_identifier, const char * name)
{
  if (implementation_identifier != identifier) {
    const char * other = implementation_identifier == nullptr ? "none" : implementation_identifier;
    throw Failure(
            RMW_RET_INCORRECT_RMW_IMPLEMENTATION,
            std::string(name) + " is of the middleware '" + other + "', not of rmw_axon");
  }
}

void set_error(const char * text) noexcept
{
  if (rmw_error_is_set()) {
    rmw_reset_error();
  }
  RMW_SET_ERROR_MSG(text);
}

}  // namespace rmw_axon

extern "C" {

const char * rmw_get_implementation_identifier(void)
{
  return rmw_axon::identifier;
}

const char * rmw_get_serialization_format(void)
{
  return "cdr";
}

}
