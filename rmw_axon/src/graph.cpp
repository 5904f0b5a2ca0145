// SPDX-License-Identifier: MIT OR Apache-2.0

// Queries of the graph: nodes, names with their types, counts.

#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "axon.h"
#include "context.hpp"
#include "error.hpp"
#include "features.hpp"
#include "graph.hpp"
#include "names.hpp"
#include "rcutils/strdup.h"
#include "rcutils/types/string_array.h"
#include "rmw/get_node_info_and_types.h"
#include "rmw/get_service_names_and_types.h"
#include "rmw/get_topic_names_and_types.h"
#include "rmw/names_and_types.h"
#include "rmw/rmw.h"
#include "rmw/sanity_checks.h"
#include "rmw/validate_namespace.h"
#include "rmw/validate_node_name.h"
#include "shown.hpp"

namespace rmw_axon
{

namespace
{

std::vector<NodeNames> nodes(const Node & node)
{
  Seen<NodeNames> seen;
  const auto visitor =
    [](void * user, const char * name, const char * name_space, const char * enclave) {
      Seen<NodeNames>::add(
        user, [&](auto & items) {items.push_back({name, name_space, enclave});});
    };
  check(axon_session_graph_nodes(session_of(node), visitor, &seen));
  std::vector<NodeNames> found = seen.take();
  leave_out_strange(found);
  return found;
}

// Returns the names of one node, if its name is given, otherwise those of all nodes.
std::vector<NameAndTypes> names(
  const Node & node, uint32_t kinds, const char * of_node, const char * of_namespace, bool all_names)
{
  Seen<NameAndTypes> seen;
  const auto visitor =
    [](void * user, const char * name, const char * const * types, size_t count) {
      Seen<NameAndTypes>::add(
        user, [&](auto & items) {items.push_back({name, {types, types + count}});});
    };
  check(
    axon_session_graph_names(session_of(node), kinds, of_node, of_namespace, visitor, &seen));
  std::vector<NameAndTypes> found = seen.take();
  leave_out_strange(found, all_names);
  return found;
}

void require_empty(rmw_names_and_types_t * names_and_types, const char * name)
{
  require(names_and_types, name);
  if (rmw_names_and_types_check_zero(names_and_types) != RMW_RET_OK) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, std::string(name) + " is not zero-initialised");
  }
}

void require_node_name(const char * name, const char * name_space)
{
  require(name, "node_name");
  require(name_space, "node_namespace");
  int result = RMW_NODE_NAME_VALID;
  if (rmw_validate_node_name(name, &result, nullptr) != RMW_RET_OK || result != RMW_NODE_NAME_VALID) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, std::string("node_name '") + name + "' is none");
  }
  result = RMW_NAMESPACE_VALID;
  if (rmw_validate_namespace(name_space, &result, nullptr) != RMW_RET_OK ||
    result != RMW_NAMESPACE_VALID)
  {
    throw Failure(
            RMW_RET_INVALID_ARGUMENT, std::string("node_namespace '") + name_space + "' is none");
  }
}

char * duplicate(const std::string & text, rcutils_allocator_t allocator)
{
  char * copy = rcutils_strdup(text.c_str(), allocator);
  require_done(copy != nullptr);
  return copy;
}

// Fills rmw's list, or leaves it unchanged.
void give(
  const std::vector<NameAndTypes> & found, rcutils_allocator_t * allocator,
  rmw_names_and_types_t * out)
{
  if (found.empty()) {
    return;
  }
  const rmw_ret_t made = rmw_names_and_types_init(out, found.size(), allocator);
  if (made != RMW_RET_OK) {
    throw Failure(made, "no memory for the names");
  }
  try {
    for (size_t i = 0; i < found.size(); ++i) {
      out->names.data[i] = duplicate(found[i].name, *allocator);
      const auto & types = found[i].types;
      require_done(
        rcutils_string_array_init(&out->types[i], types.size(), allocator) == RCUTILS_RET_OK);
      for (size_t j = 0; j < types.size(); ++j) {
        out->types[i].data[j] = duplicate(types[j], *allocator);
      }
    }
  } catch (...) {
    std::ignore = rmw_names_and_types_fini(out);
    throw;
  }
}

void names_of_node(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * node_name,
  const char * node_namespace, uint32_t kind, bool all_names, rmw_names_and_types_t * out,
  const char * out_name)
{
  const Node & of = node_of(node);
  require_allocator(allocator);
  require_node_name(node_name, node_namespace);
  require_empty(out, out_name);
  give(names(of, kind, node_name, node_namespace, all_names), allocator, out);
}

rmw_ret_t count(const rmw_node_t * node, const char * name, uint32_t kind, size_t * count)
{
  return guarded(
    [&] {
      const Node & of = node_of(node);
      const std::string topic = topic_name(name, false);
      require(count, "count");
      check(axon_session_graph_count(session_of(of), kind, topic.c_str(), count));
    });
}

void require_zero(const rcutils_string_array_t * array, const char * name)
{
  require(array, name);
  if (array->size != 0 || array->data != nullptr) {
    throw Failure(RMW_RET_INVALID_ARGUMENT, std::string(name) + " is not zero-initialised");
  }
}

// Returns node names in up to three lists, or none of them if there is too little memory.
rmw_ret_t node_names(
  const rmw_node_t * node, rcutils_string_array_t * names, rcutils_string_array_t * namespaces,
  rcutils_string_array_t * enclaves)
{
  return guarded(
    [&] {
      const auto found = nodes(node_of(node));
      rcutils_allocator_t allocator = rcutils_get_default_allocator();
      const auto give = [&](rcutils_string_array_t * out, std::string NodeNames::* part) {
        if (out == nullptr) {
          return;
        }
        require_done(rcutils_string_array_init(out, found.size(), &allocator) == RCUTILS_RET_OK);
        for (size_t i = 0; i < found.size(); ++i) {
          out->data[i] = duplicate(found[i].*part, allocator);
        }
      };
      try {
        give(names, &NodeNames::name);
        give(namespaces, &NodeNames::name_space);
        give(enclaves, &NodeNames::enclave);
      } catch (...) {
        for (rcutils_string_array_t * out : {names, namespaces, enclaves}) {
          if (out != nullptr && out->data != nullptr) {
            std::ignore = rcutils_string_array_fini(out);
          }
        }
        throw;
      }
    });
}

}  // namespace

}  // namespace rmw_axon

using rmw_axon::guarded;
using rmw_axon::node_of;

extern "C" {

rmw_ret_t rmw_get_node_names(
  const rmw_node_t * node, rcutils_string_array_t * node_names,
  rcutils_string_array_t * node_namespaces)
{
  const rmw_ret_t judged = guarded(
    [&] {
      node_of(node);
      rmw_axon::require_zero(node_names, "node_names");
      rmw_axon::require_zero(node_namespaces, "node_namespaces");
    });
  return judged != RMW_RET_OK ? judged :
         rmw_axon::node_names(node, node_names, node_namespaces, nullptr);
}

rmw_ret_t rmw_get_node_names_with_enclaves(
  const rmw_node_t * node, rcutils_string_array_t * node_names,
  rcutils_string_array_t * node_namespaces, rcutils_string_array_t * enclaves)
{
  const rmw_ret_t judged = guarded(
    [&] {
      node_of(node);
      rmw_axon::require_zero(node_names, "node_names");
      rmw_axon::require_zero(node_namespaces, "node_namespaces");
      rmw_axon::require_zero(enclaves, "enclaves");
    });
  return judged != RMW_RET_OK ? judged :
         rmw_axon::node_names(node, node_names, node_namespaces, enclaves);
}

rmw_ret_t rmw_get_topic_names_and_types(
  const rmw_node_t * node, rcutils_allocator_t * allocator, bool no_demangle,
  rmw_names_and_types_t * topic_names_and_types)
{
  return guarded(
    [&] {
      const auto & of = node_of(node);
      rmw_axon::require_allocator(allocator);
      rmw_axon::require_empty(topic_names_and_types, "topic_names_and_types");
      const uint32_t kinds = AXON_KIND_PUBLISHER | AXON_KIND_SUBSCRIPTION;
      const auto found = rmw_axon::names(of, kinds, nullptr, nullptr, no_demangle);
      rmw_axon::give(found, allocator, topic_names_and_types);
    });
}

rmw_ret_t rmw_get_service_names_and_types(
  const rmw_node_t * node, rcutils_allocator_t * allocator,
  rmw_names_and_types_t * service_names_and_types)
{
  return guarded(
    [&] {
      const auto & of = node_of(node);
      rmw_axon::require_allocator(allocator);
      rmw_axon::require_empty(service_names_and_types, "service_names_and_types");
      const uint32_t kinds = AXON_KIND_SERVER | AXON_KIND_CLIENT;
      const auto found = rmw_axon::names(of, kinds, nullptr, nullptr, false);
      rmw_axon::give(found, allocator, service_names_and_types);
    });
}

rmw_ret_t rmw_get_publisher_names_and_types_by_node(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * node_name,
  const char * node_namespace, bool no_demangle, rmw_names_and_types_t * topic_names_and_types)
{
  return guarded(
    [&] {
      rmw_axon::names_of_node(
        node, allocator, node_name, node_namespace, AXON_KIND_PUBLISHER, no_demangle,
        topic_names_and_types, "topic_names_and_types");
    });
}

rmw_ret_t rmw_get_subscriber_names_and_types_by_node(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * node_name,
  const char * node_namespace, bool no_demangle, rmw_names_and_types_t * topic_names_and_types)
{
  return guarded(
    [&] {
      rmw_axon::names_of_node(
        node, allocator, node_name, node_namespace, AXON_KIND_SUBSCRIPTION, no_demangle,
        topic_names_and_types, "topic_names_and_types");
    });
}

rmw_ret_t rmw_get_service_names_and_types_by_node(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * node_name,
  const char * node_namespace, rmw_names_and_types_t * service_names_and_types)
{
  return guarded(
    [&] {
      rmw_axon::names_of_node(
        node, allocator, node_name, node_namespace, AXON_KIND_SERVER, false,
        service_names_and_types, "service_names_and_types");
    });
}

rmw_ret_t rmw_get_client_names_and_types_by_node(
  const rmw_node_t * node, rcutils_allocator_t * allocator, const char * node_name,
  const char * node_namespace, rmw_names_and_types_t * service_names_and_types)
{
  return guarded(
    [&] {
      rmw_axon::names_of_node(
        node, allocator, node_name, node_namespace, AXON_KIND_CLIENT, false,
        service_names_and_types, "service_names_and_types");
    });
}

rmw_ret_t rmw_count_publishers(const rmw_node_t * node, const char * topic_name, size_t * count)
{
  return rmw_axon::count(node, topic_name, AXON_KIND_PUBLISHER, count);
}

rmw_ret_t rmw_count_subscribers(const rmw_node_t * node, const char * topic_name, size_t * count)
{
  return rmw_axon::count(node, topic_name, AXON_KIND_SUBSCRIPTION, count);
}

#if AXON_RMW_IRON
rmw_ret_t rmw_count_clients(const rmw_node_t * node, const char * service_name, size_t * count)
{
  return rmw_axon::count(node, service_name, AXON_KIND_CLIENT, count);
}

rmw_ret_t rmw_count_services(const rmw_node_t * node, const char * service_name, size_t * count)
{
  return rmw_axon::count(node, service_name, AXON_KIND_SERVER, count);
}
#endif

}
