// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef QOS_HPP_
#define QOS_HPP_

#include "axon.h"
#include "rmw/qos_policy_kind.h"
#include "rmw/types.h"

namespace rmw_axon
{

// A profile as AXON takes it. Throws Failure where a policy is unknown or AXON has none like it.
axon_qos_t to_core(const rmw_qos_profile_t & profile);

// What AXON says that an endpoint has.
rmw_qos_profile_t from_core(const axon_qos_t & qos);

// AXON_POLICY_*, as rmw's events name it.
rmw_qos_policy_kind_t policy_kind(uint32_t policy);

// Nanoseconds for AXON_*_wait and timeouts: null is for ever, and so is what is longer than 292 years.
int64_t timeout(const rmw_time_t * time);

}  // namespace rmw_axon

#endif  // QOS_HPP_
