// SPDX-License-Identifier: MIT OR Apache-2.0

#ifndef QOS_HPP_
#define QOS_HPP_

#include "axon.h"
#include "rmw/qos_policy_kind.h"
#include "rmw/types.h"

namespace rmw_axon
{

// Converts a profile to AXON's. Throws Failure if a policy is unknown or AXON has no equivalent.
axon_qos_t to_core(const rmw_qos_profile_t & profile);

// Converts the QoS that AXON reports for an endpoint.
rmw_qos_profile_t from_core(const axon_qos_t & qos);

// Converts AXON_POLICY_* to rmw's policy kind.
rmw_qos_policy_kind_t policy_kind(uint32_t policy);

// Converts a timeout for AXON_*_wait to nanoseconds. Null means no timeout, as does a time of more than 292
// years.
int64_t timeout(const rmw_time_t * time);

}  // namespace rmw_axon

#endif  // QOS_HPP_
