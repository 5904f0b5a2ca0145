// SPDX-License-Identifier: MIT OR Apache-2.0

// Tests the tracepoints of each way to publish, take and call.

#include <gtest/gtest.h>

#include <array>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

#include "axon.h"
#include "rcutils/strdup.h"
#include "rmw/error_handling.h"
#include "rmw/get_topic_endpoint_info.h"
#include "rmw/rmw.h"
#include "rosidl_typesupport_cpp/message_type_support.hpp"
#include "rosidl_typesupport_cpp/service_type_support.hpp"
#include "test_msgs/msg/basic_types.hpp"
#include "test_msgs/msg/unbounded_sequences.hpp"
#include "test_msgs/srv/basic_types.hpp"
#include "trace_recorder.hpp"

namespace
{

template<typename Bytes>
std::array<uint8_t, 16> gid_of(const Bytes & bytes)
{
  std::array<uint8_t, 16> gid{};
  std::memcpy(gid.data(), bytes, gid.size());
  return gid;
}

using test_msgs::msg::BasicTypes;
using test_msgs::msg::UnboundedSequences;

// Whether rmw_publish records the source timestamp and its publisher.
constexpr bool has_timestamp = AXON_TRACE_TIMESTAMP != 0;

class Trace : public testing::Test
{
protected:
  void SetUp() override
  {
    // Everything is within this process: the session of a context needs no daemon.
    setenv("AXON_DAEMON", "off", 1);
    recording = true;
    ASSERT_EQ(RMW_RET_OK, rmw_init_options_init(&options, rcutils_get_default_allocator()));
    options.enclave = rcutils_strdup("/", options.allocator);
    ASSERT_EQ(RMW_RET_OK, rmw_init(&options, &context)) << rmw_get_error_string().str;
    node = rmw_create_node(&context, "traced", "/");
    ASSERT_NE(nullptr, node) << rmw_get_error_string().str;
    events.clear();
  }

  void TearDown() override
  {
    EXPECT_EQ(RMW_RET_OK, rmw_destroy_node(node));
    EXPECT_EQ(RMW_RET_OK, rmw_shutdown(&context));
    EXPECT_EQ(RMW_RET_OK, rmw_context_fini(&context));
    EXPECT_EQ(RMW_RET_OK, rmw_init_options_fini(&options));
    rmw_reset_error();
  }

  template<typename Message>
  static const rosidl_message_type_support_t * type()
  {
    return rosidl_typesupport_cpp::get_message_type_support_handle<Message>();
  }

  rmw_init_options_t options = rmw_get_zero_initialized_init_options();
  rmw_context_t context = rmw_get_zero_initialized_context();
  rmw_node_t * node = nullptr;
};

// A publisher and a subscription of one topic.
template<typename Message>
class Topic
{
public:
  explicit Topic(rmw_node_t * node, bool with_subscription = true)
  : node_(node)
  {
    const auto * type = rosidl_typesupport_cpp::get_message_type_support_handle<Message>();
    const auto qos = rmw_qos_profile_default;
    const auto of_publisher = rmw_get_default_publisher_options();
    publisher = rmw_create_publisher(node, type, "/traced", &qos, &of_publisher);
    EXPECT_NE(nullptr, publisher) << rmw_get_error_string().str;
    if (with_subscription) {
      const auto of_subscription = rmw_get_default_subscription_options();
      subscription = rmw_create_subscription(node, type, "/traced", &qos, &of_subscription);
      EXPECT_NE(nullptr, subscription) << rmw_get_error_string().str;
    }
  }

  ~Topic()
  {
    if (subscription != nullptr) {
      EXPECT_EQ(RMW_RET_OK, rmw_destroy_subscription(node_, subscription));
    }
    EXPECT_EQ(RMW_RET_OK, rmw_destroy_publisher(node_, publisher));
  }

  // Returns the only recorded publication, after the checks that all publications share.
  Event published(const void * message)
  {
    const auto found = named("rmw_publish");
    EXPECT_EQ(1u, found.size());
    if (found.size() != 1) {
      return {};
    }
    EXPECT_EQ(message, found[0].message);
    if (has_timestamp) {
      EXPECT_EQ(publisher, found[0].handle);
      EXPECT_GT(found[0].timestamp, 0);
    }
    return found[0];
  }

  // Checks that the only recorded take is of `published`.
  void taken(const Event & published, const void * message, int64_t source_timestamp)
  {
    const auto found = named("rmw_take");
    ASSERT_EQ(1u, found.size());
    EXPECT_EQ(subscription, found[0].handle);
    EXPECT_EQ(message, found[0].message);
    EXPECT_TRUE(found[0].taken);
    EXPECT_EQ(source_timestamp, found[0].timestamp);
    if (has_timestamp) {
      EXPECT_EQ(published.timestamp, found[0].timestamp);
    }
  }

  // Checks `taken` for a way to take that does not return the source timestamp.
  void taken(const Event & published, const void * message)
  {
    const auto found = named("rmw_take");
    ASSERT_EQ(1u, found.size());
    taken(published, message, found[0].timestamp);
    EXPECT_GT(found[0].timestamp, 0);
  }

  rmw_publisher_t * publisher = nullptr;
  rmw_subscription_t * subscription = nullptr;

private:
  rmw_node_t * node_;
};

class Serialized
{
public:
  Serialized()
  {
    const auto allocator = rcutils_get_default_allocator();
    EXPECT_EQ(RMW_RET_OK, rmw_serialized_message_init(&message, 0, &allocator));
  }
  ~Serialized() {EXPECT_EQ(RMW_RET_OK, rmw_serialized_message_fini(&message));}

  rmw_serialized_message_t message = rmw_get_zero_initialized_serialized_message();
};

TEST_F(Trace, endpoints_are_told_with_their_gids)
{
  Topic<BasicTypes> topic(node);
  const auto publishers = named("rmw_publisher_init");
  ASSERT_EQ(1u, publishers.size());
  EXPECT_EQ(topic.publisher, publishers[0].handle);
  rmw_gid_t gid{};
  ASSERT_EQ(RMW_RET_OK, rmw_get_gid_for_publisher(topic.publisher, &gid));
  EXPECT_EQ(gid_of(gid.data), publishers[0].gid);

  const auto subscriptions = named("rmw_subscription_init");
  ASSERT_EQ(1u, subscriptions.size());
  EXPECT_EQ(topic.subscription, subscriptions[0].handle);
  auto allocator = rcutils_get_default_allocator();
  auto infos = rmw_get_zero_initialized_topic_endpoint_info_array();
  ASSERT_EQ(
    RMW_RET_OK, rmw_get_subscriptions_info_by_topic(node, &allocator, "/traced", false, &infos));
  ASSERT_EQ(1u, infos.size);
  EXPECT_EQ(gid_of(infos.info_array[0].endpoint_gid), subscriptions[0].gid);
  EXPECT_EQ(RMW_RET_OK, rmw_topic_endpoint_info_array_fini(&infos, &allocator));
}

TEST_F(Trace, take_joins_publish)
{
  Topic<BasicTypes> topic(node);
  BasicTypes sent, got;
  ASSERT_EQ(RMW_RET_OK, rmw_publish(topic.publisher, &sent, nullptr));
  const Event published = topic.published(&sent);
  bool taken = false;
  ASSERT_EQ(RMW_RET_OK, rmw_take(topic.subscription, &got, &taken, nullptr));
  ASSERT_TRUE(taken);
  topic.taken(published, &got);
}

TEST_F(Trace, take_with_info_joins_publish_of_a_large_message)
{
  Topic<UnboundedSequences> topic(node);
  UnboundedSequences sent, got;
  sent.uint8_values.resize(100000);
  ASSERT_EQ(RMW_RET_OK, rmw_publish(topic.publisher, &sent, nullptr));
  const Event published = topic.published(&sent);
  bool taken = false;
  auto info = rmw_get_zero_initialized_message_info();
  ASSERT_EQ(RMW_RET_OK, rmw_take_with_info(topic.subscription, &got, &taken, &info, nullptr));
  ASSERT_TRUE(taken);
  topic.taken(published, &got, info.source_timestamp);
}

TEST_F(Trace, serialized_take_joins_serialized_publish)
{
  Topic<BasicTypes> topic(node);
  Serialized sent, got;
  const BasicTypes message;
  ASSERT_EQ(RMW_RET_OK, rmw_serialize(&message, type<BasicTypes>(), &sent.message));
  for (const bool with_info : {false, true}) {
    events.clear();
    ASSERT_EQ(
      RMW_RET_OK, rmw_publish_serialized_message(topic.publisher, &sent.message, nullptr));
    const Event published = topic.published(&sent.message);
    bool taken = false;
    auto info = rmw_get_zero_initialized_message_info();
    if (with_info) {
      ASSERT_EQ(
        RMW_RET_OK, rmw_take_serialized_message_with_info(
          topic.subscription, &got.message, &taken, &info, nullptr));
      topic.taken(published, &got.message, info.source_timestamp);
    } else {
      ASSERT_EQ(
        RMW_RET_OK,
        rmw_take_serialized_message(topic.subscription, &got.message, &taken, nullptr));
      topic.taken(published, &got.message);
    }
    ASSERT_TRUE(taken);
  }
}

TEST_F(Trace, loaned_take_joins_loaned_publish)
{
  Topic<BasicTypes> topic(node);
  for (const bool with_info : {false, true}) {
    events.clear();
    void * sent = nullptr;
    ASSERT_EQ(
      RMW_RET_OK, rmw_borrow_loaned_message(topic.publisher, type<BasicTypes>(), &sent));
    ASSERT_EQ(RMW_RET_OK, rmw_publish_loaned_message(topic.publisher, sent, nullptr));
    const Event published = topic.published(sent);
    void * got = nullptr;
    bool taken = false;
    auto info = rmw_get_zero_initialized_message_info();
    if (with_info) {
      ASSERT_EQ(
        RMW_RET_OK, rmw_take_loaned_message_with_info(
          topic.subscription, &got, &taken, &info, nullptr));
      topic.taken(published, got, info.source_timestamp);
    } else {
      ASSERT_EQ(
        RMW_RET_OK, rmw_take_loaned_message(topic.subscription, &got, &taken, nullptr));
      topic.taken(published, got);
    }
    ASSERT_TRUE(taken);
    ASSERT_EQ(
      RMW_RET_OK, rmw_return_loaned_message_from_subscription(topic.subscription, got));
  }
}

TEST_F(Trace, each_message_of_a_sequence_joins_its_publish)
{
  Topic<BasicTypes> topic(node);
  BasicTypes sent;
  for (int count = 0; count < 3; ++count) {
    ASSERT_EQ(RMW_RET_OK, rmw_publish(topic.publisher, &sent, nullptr));
  }
  std::array<BasicTypes, 5> got;
  std::array<void *, 5> places;
  std::array<rmw_message_info_t, 5> infos{};
  for (size_t at = 0; at < got.size(); ++at) {
    places[at] = &got[at];
  }
  auto allocator = rcutils_get_default_allocator();
  rmw_message_sequence_t messages{places.data(), 0, places.size(), &allocator};
  rmw_message_info_sequence_t of_messages{infos.data(), 0, infos.size(), &allocator};
  size_t taken = 0;
  ASSERT_EQ(
    RMW_RET_OK,
    rmw_take_sequence(topic.subscription, 5, &messages, &of_messages, &taken, nullptr));
  ASSERT_EQ(3u, taken);
  const auto published = named("rmw_publish");
  const auto takes = named("rmw_take");
  ASSERT_EQ(3u, published.size());
  // The fourth take found no message.
  ASSERT_EQ(4u, takes.size());
  EXPECT_FALSE(takes[3].taken);
  EXPECT_EQ(0, takes[3].timestamp);
  for (size_t at = 0; at < 3; ++at) {
    EXPECT_TRUE(takes[at].taken);
    EXPECT_EQ(places[at], takes[at].message);
    EXPECT_EQ(infos[at].source_timestamp, takes[at].timestamp);
    if (has_timestamp) {
      EXPECT_EQ(published[at].timestamp, takes[at].timestamp);
    }
  }
}

TEST_F(Trace, taking_nothing_is_told)
{
  Topic<BasicTypes> topic(node);
  BasicTypes got;
  Serialized serialized;
  void * lent = nullptr;
  bool taken = true;
  ASSERT_EQ(RMW_RET_OK, rmw_take(topic.subscription, &got, &taken, nullptr));
  ASSERT_EQ(
    RMW_RET_OK,
    rmw_take_serialized_message(topic.subscription, &serialized.message, &taken, nullptr));
  ASSERT_EQ(RMW_RET_OK, rmw_take_loaned_message(topic.subscription, &lent, &taken, nullptr));
  const auto takes = named("rmw_take");
  ASSERT_EQ(3u, takes.size());
  for (const Event & event : takes) {
    EXPECT_EQ(topic.subscription, event.handle);
    EXPECT_FALSE(event.taken);
    EXPECT_EQ(0, event.timestamp);
  }
  EXPECT_EQ(nullptr, takes[2].message);
}

TEST_F(Trace, a_message_that_cannot_be_read_is_no_taken_message)
{
  Topic<BasicTypes> topic(node);
  Serialized sent;
  ASSERT_EQ(RMW_RET_OK, rmw_serialized_message_resize(&sent.message, 5));
  std::memcpy(sent.message.buffer, "\0\1\0\0\0", 5);
  sent.message.buffer_length = 5;
  ASSERT_EQ(RMW_RET_OK, rmw_publish_serialized_message(topic.publisher, &sent.message, nullptr));
  const Event published = topic.published(&sent.message);
  BasicTypes got;
  bool taken = false;
  EXPECT_EQ(RMW_RET_ERROR, rmw_take(topic.subscription, &got, &taken, nullptr));
  EXPECT_FALSE(taken);
  const auto takes = named("rmw_take");
  ASSERT_EQ(1u, takes.size());
  EXPECT_FALSE(takes[0].taken);
  EXPECT_GT(takes[0].timestamp, 0);
  if (has_timestamp) {
    EXPECT_EQ(published.timestamp, takes[0].timestamp);
  }
}

TEST_F(Trace, a_message_that_nobody_reads_is_published)
{
  Topic<BasicTypes> topic(node, false);
  const BasicTypes sent;
  ASSERT_EQ(RMW_RET_OK, rmw_publish(topic.publisher, &sent, nullptr));
  topic.published(&sent);
}

TEST_F(Trace, refused_arguments_are_not_published)
{
  Topic<BasicTypes> topic(node);
  EXPECT_EQ(RMW_RET_INVALID_ARGUMENT, rmw_publish(topic.publisher, nullptr, nullptr));
  EXPECT_EQ(
    RMW_RET_INVALID_ARGUMENT,
    rmw_publish_serialized_message(topic.publisher, nullptr, nullptr));
  BasicTypes not_lent;
  EXPECT_EQ(
    RMW_RET_INVALID_ARGUMENT, rmw_publish_loaned_message(topic.publisher, &not_lent, nullptr));
  EXPECT_TRUE(named("rmw_publish").empty());
}

TEST_F(Trace, a_publisher_that_no_session_records_computes_no_timestamp)
{
  if (!has_timestamp) {
    GTEST_SKIP() << "this tracetools does not say whether a tracepoint is recorded";
  }
  recording = false;
  Topic<BasicTypes> topic(node);
  const BasicTypes sent;
  BasicTypes got;
  ASSERT_EQ(RMW_RET_OK, rmw_publish(topic.publisher, &sent, nullptr));
  EXPECT_TRUE(named("rmw_publish").empty());
  bool taken = false;
  auto info = rmw_get_zero_initialized_message_info();
  ASSERT_EQ(RMW_RET_OK, rmw_take_with_info(topic.subscription, &got, &taken, &info, nullptr));
  ASSERT_TRUE(taken);
  EXPECT_GT(info.source_timestamp, 0);
}

#if AXON_TRACE_SERVICES
TEST_F(Trace, a_call_is_followed_to_the_server_and_back)
{
  using test_msgs::srv::BasicTypes;
  const auto * type = rosidl_typesupport_cpp::get_service_type_support_handle<BasicTypes>();
  const auto qos = rmw_qos_profile_services_default;
  rmw_service_t * service = rmw_create_service(node, type, "/traced", &qos);
  rmw_client_t * client = rmw_create_client(node, type, "/traced", &qos);
  ASSERT_TRUE(service != nullptr && client != nullptr) << rmw_get_error_string().str;
  const auto clients = named("rmw_client_init");
  ASSERT_EQ(1u, clients.size());
  EXPECT_EQ(client, clients[0].handle);

  BasicTypes::Request request, asked;
  BasicTypes::Response response, answered;
  rmw_service_info_t header{}, answer{};
  bool taken = true;
  ASSERT_EQ(RMW_RET_OK, rmw_take_request(service, &header, &asked, &taken));
  ASSERT_EQ(RMW_RET_OK, rmw_take_response(client, &answer, &answered, &taken));
  ASSERT_FALSE(taken);

  int64_t sequence = 0;
  ASSERT_EQ(RMW_RET_OK, rmw_send_request(client, &request, &sequence));
  ASSERT_EQ(RMW_RET_OK, rmw_take_request(service, &header, &asked, &taken));
  ASSERT_TRUE(taken);
  ASSERT_EQ(RMW_RET_OK, rmw_send_response(service, &header.request_id, &response));
  ASSERT_EQ(RMW_RET_OK, rmw_take_response(client, &answer, &answered, &taken));
  ASSERT_TRUE(taken);

  const auto sent = named("rmw_send_request");
  ASSERT_EQ(1u, sent.size());
  EXPECT_EQ(client, sent[0].handle);
  EXPECT_EQ(&request, sent[0].message);
  EXPECT_EQ(sequence, sent[0].sequence);

  const auto requests = named("rmw_take_request");
  ASSERT_EQ(2u, requests.size());
  EXPECT_FALSE(requests[0].taken);
  EXPECT_EQ(0, requests[0].sequence);
  EXPECT_TRUE(requests[1].taken);
  EXPECT_EQ(service, requests[1].handle);
  EXPECT_EQ(&asked, requests[1].message);
  EXPECT_EQ(sequence, requests[1].sequence);
  EXPECT_EQ(clients[0].gid, requests[1].gid);

  const auto sent_back = named("rmw_send_response");
  ASSERT_EQ(1u, sent_back.size());
  EXPECT_EQ(service, sent_back[0].handle);
  EXPECT_EQ(&response, sent_back[0].message);
  EXPECT_EQ(sequence, sent_back[0].sequence);
  EXPECT_EQ(clients[0].gid, sent_back[0].gid);
  EXPECT_EQ(answer.source_timestamp, sent_back[0].timestamp);

  const auto responses = named("rmw_take_response");
  ASSERT_EQ(2u, responses.size());
  EXPECT_FALSE(responses[0].taken);
  EXPECT_EQ(0, responses[0].timestamp);
  EXPECT_TRUE(responses[1].taken);
  EXPECT_EQ(client, responses[1].handle);
  EXPECT_EQ(&answered, responses[1].message);
  EXPECT_EQ(sequence, responses[1].sequence);
  EXPECT_EQ(sent_back[0].timestamp, responses[1].timestamp);

  EXPECT_EQ(RMW_RET_OK, rmw_destroy_client(node, client));
  EXPECT_EQ(RMW_RET_OK, rmw_destroy_service(node, service));
}
#endif

}  // namespace
