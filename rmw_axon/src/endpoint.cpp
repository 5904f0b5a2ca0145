// SPDX-License-Identifier: MIT OR Apache-2.0

#include "endpoint.hpp"

#include <algorithm>

#include "error.hpp"
#include "features.hpp"
#include "qos.hpp"

namespace rmw_axon
{

namespace
{

template<typename TypeSupport>
axon_endpoint_options_t options_of(
  EndpointNames & names, const rmw_qos_profile_t & profile, const TypeSupport * type_support)
{
  axon_endpoint_options_t options{};
  options.topic = names.name.c_str();
  options.type_name = names.type.c_str();
  options.qos = to_core(profile);
#if AXON_RMW_IRON
  if (type_support->get_type_hash_func != nullptr) {
    const rosidl_type_hash_t * hash = type_support->get_type_hash_func(type_support);
    if (hash != nullptr && hash->version == 1) {
      std::copy_n(hash->value, names.hash.size(), names.hash.begin());
      options.type_hash = names.hash.data();
      options.type_hash_size = names.hash.size();
    }
  }
#else
  (void)type_support;
#endif
  return options;
}

}  // namespace

EventSources::~EventSources()
{
  for (const auto & source : sources_) {
    if (source) {
      axon_session_event_destroy(source->handle);
    }
  }
}

Service::~Service()
{
  axon_session_server_destroy(handle);
}

Client::~Client()
{
  axon_session_client_destroy(handle);
}

std::string label(const char * what, const char * name, const Node & node)
{
  const char * slash = node.name_space == "/" ? "" : "/";
  return std::string(what) + " " + name + " (node " + node.name_space + slash + node.name + ")";
}

Publisher & publisher_of(const rmw_publisher_t * publisher)
{
  require_object(publisher, "publisher");
  return *static_cast<Publisher *>(publisher->data);
}

Subscription & subscription_of(const rmw_subscription_t * subscription)
{
  require_object(subscription, "subscription");
  return *static_cast<Subscription *>(subscription->data);
}

Service & service_of(const rmw_service_t * service)
{
  require_object(service, "service");
  return *static_cast<Service *>(service->data);
}

Client & client_of(const rmw_client_t * client)
{
  require_object(client, "client");
  return *static_cast<Client *>(client->data);
}

axon_endpoint_options_t endpoint_options(
  EndpointNames & names, const rmw_qos_profile_t & profile,
  const rosidl_message_type_support_t * type_support)
{
  return options_of(names, profile, type_support);
}

axon_endpoint_options_t endpoint_options(
  EndpointNames & names, const rmw_qos_profile_t & profile,
  const rosidl_service_type_support_t * type_support)
{
  return options_of(names, profile, type_support);
}

Taken::~Taken()
{
  if (sample.id != 0) {
    axon_session_sample_release(sample);
  }
}

axon_sample_t Taken::keep()
{
  const axon_sample_t kept = sample;
  sample.id = 0;
  return kept;
}

}  // namespace rmw_axon
