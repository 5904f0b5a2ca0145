// SPDX-License-Identifier: MIT OR Apache-2.0

// The differences between ROS distributions, detected from their headers: Humble (rmw 6.1), Iron (7.1), Jazzy
// (7.3), Kilted (7.8), Lyrical and Rolling (7.10). Only cdr/buffer.hpp also detects a feature of rosidl.

#ifndef FEATURES_HPP_
#define FEATURES_HPP_

#include "rmw/rmw.h"

// Iron: discovery options instead of localhost_only, best-available policies, type hashes, matched and
// incompatible-type events, clients' GIDs, counts of clients and services.
#if __has_include("rmw/discovery_options.h")
#define AXON_RMW_IRON 1
#else
#define AXON_RMW_IRON 0
#endif

// Iron to Jazzy: localhost_only is there beside the discovery options. Humble: alone.
#if __has_include("rmw/localhost.h")
#define AXON_RMW_LOCALHOST_ONLY 1
#else
#define AXON_RMW_LOCALHOST_ONLY 0
#endif

// Messages of types that are known at run time only.
#if __has_include("rmw/dynamic_message_type_support.h")
#define AXON_RMW_DYNAMIC_MESSAGES 1
#else
#define AXON_RMW_DYNAMIC_MESSAGES 0
#endif

// The event type with the highest number. RMW_EVENT_INVALID does not bound them: it follows the last one up to
// Jazzy, and is 0 from Kilted on.
#if AXON_RMW_IRON
#define AXON_RMW_LAST_EVENT RMW_EVENT_PUBLICATION_MATCHED
#else
#define AXON_RMW_LAST_EVENT RMW_EVENT_OFFERED_QOS_INCOMPATIBLE
#endif

// The return code of rmw_destroy_wait_set and rmw_service_server_is_available for a null argument. The
// headers of all distributions say RMW_RET_INVALID_ARGUMENT; rmw's tests up to Jazzy expect RMW_RET_ERROR.
#if __has_include("rmw/enclave.h")
#define AXON_RMW_NULL_ARGUMENT RMW_RET_INVALID_ARGUMENT
#else
#define AXON_RMW_NULL_ARGUMENT RMW_RET_ERROR
#endif

// After Kilted: the endpoints of a service can be queried like those of a topic.
#if __has_include("rmw/get_service_endpoint_info.h")
#define AXON_RMW_SERVICE_ENDPOINT_INFO 1
#else
#define AXON_RMW_SERVICE_ENDPOINT_INFO 0
#endif

#endif  // FEATURES_HPP_
