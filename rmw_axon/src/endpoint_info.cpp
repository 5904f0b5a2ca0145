// SPDX-License-Identifier: MIT OR Apache-2.0

// Queries of the graph about single endpoints: their nodes, their types and their QoS.

#include <algorithm>
#include <string>
#include <tuple>
#include <vector>

#include "axon.h"
#include "error.hpp"
#include "features.hpp"
#include "gid.hpp"
#include "graph.hpp"
#include "qos.hpp"
#include "rmw/get_topic_endpoint_info.h"
#include "rmw/rmw.h"
#include "rmw/topic_endpoint_info_array.h"
#include "shown.hpp"
#if AXON_RMW_SERVICE_ENDPOINT_INFO
#include "rmw/get_service_endpoint_info.h"
#include "rmw/service_endpoint_info_array.h"
#endif

namespace rmw_axon
{

namespace
{

struct EndpointInfo
{
  axon_gid_t gid{};
  axon_qos_t qos{};
  std::string node;
  std::string name_space;
  std::string type;
  std::vector<uint8_t> hash;
};

std::vector<EndpointInfo> endpoints(const Node & node, uint32_t kind, const std::string & topic)
{
  Seen<EndpointInfo> seen;
  const auto visitor = [](void * user, const axon_endpoint_t * endpoint) {
      Seen<EndpointInfo>::add(
        user, [&](auto & items) {
          items.push_back(
            {endpoint->gid, endpoint->qos, printable(endpoint->node), printable(endpoint->namespace_),
              printable(endpoint->type_name),
              {endpoint->type_hash, endpoint->type_hash + endpoint->type_hash_size}});
        });
    };
  check(axon_session_graph_endpoints(session_of(node), kind, topic.c_str(), visitor, &seen));
  return seen.take();
}

void done(rmw_ret_t returned)
{
  require_done(returned == RMW_RET_OK);
}

#if AXON_RMW_IRON
rosidl_type_hash_t type_hash(const EndpointInfo & of)
{
  rosidl_type_hash_t hash = rosidl_get_zero_initialized_type_hash();
  if (of.hash.size() == sizeof(hash.value)) {
    hash.version = 1;
    std::copy(of.hash.begin(), of.hash.end(), hash.value);
  }
  return hash;
}
#endif

// The types and functions that rmw has for topics, under names that also fit services.
struct OfTopic
{
  using Info = rmw_topic_endpoint_info_t;
  using Array = rmw_topic_endpoint_info_array_t;
  static constexpr auto check_zero = rmw_topic_endpoint_info_array_check_zero;
  static constexpr auto init = rmw_topic_endpoint_info_array_init_with_size;
  static constexpr auto fini = rmw_topic_endpoint_info_array_fini;
  static constexpr auto zero = rmw_get_zero_initialized_topic_endpoint_info;

  static void fill(
    const EndpointInfo & from, rmw_endpoint_type_t type, rcutils_allocator_t * allocator, Info * to)
  {
    done(rmw_topic_endpoint_info_set_node_name(to, from.node.c_str(), allocator));
    done(rmw_topic_endpoint_info_set_node_namespace(to, from.name_space.c_str(), allocator));
    done(rmw_topic_endpoint_info_set_topic_type(to, from.type.c_str(), allocator));
    done(rmw_topic_endpoint_info_set_endpoint_type(to, type));
    const rmw_qos_profile_t qos = from_core(from.qos);
    done(rmw_topic_endpoint_info_set_qos_profile(to, &qos));
    const rmw_gid_t gid = from_core(from.gid);
    done(rmw_topic_endpoint_info_set_gid(to, gid.data, sizeof(gid.data)));
#if AXON_RMW_IRON
    const rosidl_type_hash_t hash = type_hash(from);
    done(rmw_topic_endpoint_info_set_topic_type_hash(to, &hash));
#endif
  }
};

#if AXON_RMW_SERVICE_ENDPOINT_INFO
// A server, or a client, is one endpoint: AXON has services of its own.
struct OfService
{
  using Info = rmw_service_endpoint_info_t;
  using Array = rmw_service_endpoint_info_array_t;
  static constexpr auto check_zero = rmw_service_endpoint_info_array_check_zero;
  static constexpr auto init = rmw_service_endpoint_info_array_init_with_size;
  static constexpr auto fini = rmw_service_endpoint_info_array_fini;
  static constexpr auto zero = rmw_get_zero_initialized_service_endpoint_info;

  static void fill(
    const EndpointInfo & from, rmw_endpoint_type_t type, rcutils_allocator_t * allocator, Info * to)
  {
    done(rmw_service_endpoint_info_set_node_name(to, from.node.c_str(), allocator));
    done(rmw_service_endpoint_info_set_node_namespace(to, from.name_space.c_str(), allocator));
    done(rmw_service_endpoint_info_set_service_type(to, from.type.c_str(), allocator));
    done(rmw_service_endpoint_info_set_endpoint_type(to, type));
    done(rmw_service_endpoint_info_set_endpoint_count(to, 1));
    const rmw_qos_profile_t qos = from_core(from.qos);
    done(rmw_service_endpoint_info_set_qos_profiles(to, &qos, 1, allocator));
    const rmw_gid_t gid = from_core(from.gid);
    done(rmw_service_endpoint_info_set_gids(to, gid.data, 1, sizeof(gid.data), allocator));
    const rosidl_type_hash_t hash = type_hash(from);
    done(rmw_service_endpoint_info_set_service_type_hash(to, &hash));
  }
};
#endif

// Fills rmw's array, or leaves it unchanged.
template<typename Of>
rmw_ret_t infos(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * name,
  const char * name_name, bool no_mangle, uint32_t kind, rmw_endpoint_type_t type,
  typename Of::Array * out)
{
  return guarded(
    [&] {
      const Node & of = node_of(node);
      require_allocator(allocator);
      require(name, name_name);
      require(out, "the array of infos");
      if (Of::check_zero(out) != RMW_RET_OK) {
        throw Failure(RMW_RET_INVALID_ARGUMENT, "the array of infos is not zero-initialised");
      }
      // No endpoint has an invalid name, and rmw.h specifies no error for it.
      std::vector<EndpointInfo> found;
      if (no_mangle || is_full_name(name)) {
        found = endpoints(of, kind, name);
      }
      if (found.empty()) {
        return;
      }
      const rmw_ret_t made = Of::init(out, found.size(), allocator);
      if (made != RMW_RET_OK) {
        throw Failure(made, "no memory for the infos");
      }
      for (size_t i = 0; i < found.size(); ++i) {
        out->info_array[i] = Of::zero();
      }
      try {
        for (size_t i = 0; i < found.size(); ++i) {
          Of::fill(found[i], type, allocator, &out->info_array[i]);
        }
      } catch (...) {
        std::ignore = Of::fini(out, allocator);
        throw;
      }
    });
}

}  // namespace

}  // namespace rmw_axon

extern "C" {

rmw_ret_t rmw_get_publishers_info_by_topic(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * topic_name,
  bool no_mangle, rmw_topic_endpoint_info_array_t * publishers_info)
{
  return rmw_axon::infos<rmw_axon::OfTopic>(
    node, allocator, topic_name, "topic_name", no_mangle, AXON_KIND_PUBLISHER,
    RMW_ENDPOINT_PUBLISHER, publishers_info);
}

rmw_ret_t rmw_get_subscriptions_info_by_topic(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * topic_name,
  bool no_mangle, rmw_topic_endpoint_info_array_t * subscriptions_info)
{
  return rmw_axon::infos<rmw_axon::OfTopic>(
    node, allocator, topic_name, "topic_name", no_mangle, AXON_KIND_SUBSCRIPTION,
    RMW_ENDPOINT_SUBSCRIPTION, subscriptions_info);
}

#if AXON_RMW_SERVICE_ENDPOINT_INFO
rmw_ret_t rmw_get_clients_info_by_service(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * service_name,
  bool no_mangle, rmw_service_endpoint_info_array_t * clients_info)
{
  return rmw_axon::infos<rmw_axon::OfService>(
    node, allocator, service_name, "service_name", no_mangle, AXON_KIND_CLIENT,
    RMW_ENDPOINT_CLIENT, clients_info);
}

rmw_ret_t rmw_get_servers_info_by_service(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * service_name,
  bool no_mangle, rmw_service_endpoint_info_array_t * servers_info)
{
  return rmw_axon::infos<rmw_axon::OfService>(
    node, allocator, service_name, "service_name", no_mangle, AXON_KIND_SERVER,
    RMW_ENDPOINT_SERVER, servers_info);
}
#endif

}
