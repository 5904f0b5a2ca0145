// SPDX-License-Identifier: MIT OR Apache-2.0

#include <memory>

#include "context.hpp"
#include "error.hpp"
#include "rmw/rmw.h"

namespace rmw_axon
{

GuardCondition::GuardCondition(rmw_context_t * context, axon_guard_t made)
: handle(made)
{
  rmw.implementation_identifier = identifier;
  rmw.context = context;
  rmw.data = this;
}

GuardCondition::~GuardCondition()
{
  axon_session_guard_destroy(handle);
}

}  // namespace rmw_axon

using rmw_axon::GuardCondition;

extern "C" {

rmw_guard_condition_t * rmw_create_guard_condition(rmw_context_t * context)
{
  return rmw_axon::guarded_pointer(
    [&] {
      axon_guard_t guard{};
      rmw_axon::check(axon_session_guard_create(rmw_axon::usable(context).session, &guard));
      return &(new GuardCondition(context, guard))->rmw;
    });
}

rmw_ret_t rmw_destroy_guard_condition(rmw_guard_condition_t * guard_condition)
{
  return rmw_axon::guarded(
    [&] {
      rmw_axon::require_object(guard_condition, "guard_condition");
      delete static_cast<GuardCondition *>(guard_condition->data);
    });
}

// A signal handler may call it: nothing here locks or allocates, unless an argument is wrong.
rmw_ret_t rmw_trigger_guard_condition(const rmw_guard_condition_t * guard_condition)
{
  if (guard_condition != nullptr &&
    guard_condition->implementation_identifier == rmw_axon::identifier)
  {
    const auto * guard = static_cast<const GuardCondition *>(guard_condition->data);
    return axon_session_guard_trigger(guard->handle) == AXON_RET_OK ? RMW_RET_OK : RMW_RET_ERROR;
  }
  return rmw_axon::guarded(
    [&] {rmw_axon::require_object(guard_condition, "guard_condition");});
}

}
