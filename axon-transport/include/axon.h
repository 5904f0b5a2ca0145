/* The C interface of AXON: sessions, in which publishers, subscriptions, services and clients meet those of
 * other processes and hosts.
 *
 * Rules for every function whose documentation does not say otherwise:
 *
 * - It may be called from any thread at any time, also concurrently with the same handle.
 * - It does not block, except on locks that are held for microseconds.
 * - It returns AXON_RET_OK or an error code. After an error it has done nothing and has written to no pointer that
 *   the caller passed. axon_session_last_error returns the error as text.
 * - It keeps no pointer that the caller passed. Strings are UTF-8 and end with a 0 byte.
 * - A callback must neither throw nor longjmp out of the call.
 * - A call that replaces or destroys a callback waits until a running call of the old callback returns. The
 *   old callback is not called again. A call from inside the callback does not wait. While an object is being
 *   destroyed, a thread that sets another callback for it gets AXON_RET_INVALID_HANDLE. The caller must not
 *   hold anything that the callback waits for.
 *
 * Handles are numbers, never pointers, and may be copied freely. A handle that is 0, stale, destroyed twice, of
 * another kind or made up gives AXON_RET_INVALID_HANDLE. A handle that a forked child inherited gives
 * AXON_RET_FORKED. Every function may return both, and also AXON_RET_INVALID_ARGUMENT for an unexpected null
 * pointer, AXON_RET_BAD_ALLOC if there is no room for a new handle, and AXON_RET_PANIC. One thread may destroy an
 * object while other threads use it: their running calls end as usual. A handle that is never destroyed keeps
 * its object alive.
 *
 * A process that executes another program without closing its sessions is gone for the others as if it had
 * been killed, but for the samples that it holds: their memory is free once that program has ended.
 *
 * Made by cbindgen from src/ffi: edit it there. */


#ifndef AXON_H
#define AXON_H

#include <stddef.h>
#include <stdint.h>

/**
 * The version of this interface. A new version means that a program compiled against an older header no
 * longer works.
 */
#define AXON_SESSION_ABI 3

/**
 * The largest size of a type's hash in bytes.
 */
#define AXON_TYPE_HASH_SIZE 64

/**
 * A source timestamp that means the time of the call.
 */
#define AXON_TIME_NOW INT64_MIN

/**
 * Subscription event: a publisher became alive or stopped being alive.
 */
#define AXON_EVENT_LIVELINESS_CHANGED 0

/**
 * Subscription event: no sample arrived within the requested deadline.
 */
#define AXON_EVENT_REQUESTED_DEADLINE_MISSED 1

/**
 * Subscription event: a publisher offers less than the subscription requests.
 */
#define AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE 2

/**
 * Subscription event: samples were lost before the subscription could take them.
 */
#define AXON_EVENT_MESSAGE_LOST 3

/**
 * Subscription event: a publisher of the topic has another type.
 */
#define AXON_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE 4

/**
 * Subscription event: a publisher was matched or unmatched.
 */
#define AXON_EVENT_SUBSCRIPTION_MATCHED 5

/**
 * Publisher event: the publisher did not assert its liveliness within its lease.
 */
#define AXON_EVENT_LIVELINESS_LOST 6

/**
 * Publisher event: the publisher did not publish within its deadline.
 */
#define AXON_EVENT_OFFERED_DEADLINE_MISSED 7

/**
 * Publisher event: a subscription requests more than the publisher offers.
 */
#define AXON_EVENT_OFFERED_QOS_INCOMPATIBLE 8

/**
 * Publisher event: a subscription of the topic has another type.
 */
#define AXON_EVENT_PUBLISHER_INCOMPATIBLE_TYPE 9

/**
 * Publisher event: a subscription was matched or unmatched.
 */
#define AXON_EVENT_PUBLICATION_MATCHED 10

/**
 * Endpoint kind: publisher.
 */
#define AXON_KIND_PUBLISHER 1

/**
 * Endpoint kind: subscription.
 */
#define AXON_KIND_SUBSCRIPTION 2

/**
 * Endpoint kind: server.
 */
#define AXON_KIND_SERVER 4

/**
 * Endpoint kind: client.
 */
#define AXON_KIND_CLIENT 8

/**
 * Debug: details that help to find a fault.
 */
#define AXON_LOG_DEBUG 10

/**
 * Informational: normal operation.
 */
#define AXON_LOG_INFO 20

/**
 * Warning: a problem that the library handles.
 */
#define AXON_LOG_WARN 30

/**
 * Error: an operation of the library failed.
 */
#define AXON_LOG_ERROR 40

/**
 * Any policy: AXON's default, which is RELIABLE, VOLATILE, KEEP_LAST and AUTOMATIC.
 */
#define AXON_CHOICE_DEFAULT 0

/**
 * Reliability, durability and liveliness: a level that matches every endpoint of the other side that the graph has
 * for the topic. A subscription gets the highest one that all publishers offer. A publisher is RELIABLE and
 * TRANSIENT_LOCAL, and MANUAL_BY_TOPIC only if a subscription requests that. The level is chosen when the endpoint is
 * created, and not again. Clients and servers get the default.
 */
#define AXON_CHOICE_BEST_AVAILABLE 255

/**
 * Samples arrive within the bounds of the history.
 */
#define AXON_RELIABILITY_RELIABLE 1

/**
 * Samples may be lost.
 */
#define AXON_RELIABILITY_BEST_EFFORT 2

/**
 * A subscription that joins late receives the publisher's history first.
 */
#define AXON_DURABILITY_TRANSIENT_LOCAL 1

/**
 * A subscription that joins late receives only samples that are published afterwards.
 */
#define AXON_DURABILITY_VOLATILE 2

/**
 * The newest `depth` samples are kept.
 */
#define AXON_HISTORY_KEEP_LAST 1

/**
 * All samples are kept, up to the memory budget. Then the publisher waits.
 */
#define AXON_HISTORY_KEEP_ALL 2

/**
 * The session asserts that a publisher is alive.
 */
#define AXON_LIVELINESS_AUTOMATIC 1

/**
 * The publisher asserts that it is alive, by publishing or by an explicit call.
 */
#define AXON_LIVELINESS_MANUAL_BY_TOPIC 3

/**
 * AXON's default: infinite.
 */
#define AXON_DURATION_DEFAULT 0

/**
 * AXON_CHOICE_BEST_AVAILABLE for a deadline or a lease.
 */
#define AXON_DURATION_BEST_AVAILABLE 18446744073709551614ull

/**
 * Infinite.
 */
#define AXON_DURATION_INFINITE 18446744073709551615ull

/**
 * The two profiles are compatible.
 */
#define AXON_QOS_COMPATIBLE 0

/**
 * The result depends on policies that are still open: default or best available.
 */
#define AXON_QOS_UNKNOWN 1

/**
 * The two profiles are incompatible.
 */
#define AXON_QOS_INCOMPATIBLE 2

/**
 * No policy is incompatible.
 */
#define AXON_POLICY_NONE 0

/**
 * The incompatible policy: reliability.
 */
#define AXON_POLICY_RELIABILITY 1

/**
 * The incompatible policy: durability.
 */
#define AXON_POLICY_DURABILITY 2

/**
 * The incompatible policy: deadline.
 */
#define AXON_POLICY_DEADLINE 3

/**
 * The incompatible policy: liveliness.
 */
#define AXON_POLICY_LIVELINESS 4

/**
 * The incompatible policy: the liveliness lease.
 */
#define AXON_POLICY_LIVELINESS_LEASE 5

/**
 * The domain in `ROS_DOMAIN_ID`, or 0 if that is not set.
 */
#define AXON_DOMAIN_ENVIRONMENT 4294967295

/**
 * The discovery range in `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS` and `ROS_LOCALHOST_ONLY`.
 */
#define AXON_DISCOVERY_ENVIRONMENT 0

/**
 * No discovery: the session reaches only its own endpoints. Static peers are ignored.
 */
#define AXON_DISCOVERY_OFF 1

/**
 * This host. Another host is reached if either of the two lists the other as a static peer.
 */
#define AXON_DISCOVERY_LOCALHOST 2

/**
 * The hosts that multicast reaches, and the static peers.
 */
#define AXON_DISCOVERY_SUBNET 3

/**
 * The hosts that multicast reaches. The list of static peers is ignored.
 */
#define AXON_DISCOVERY_SYSTEM_DEFAULT 4

/**
 * `AXON_SECURITY_MODE` is `classic` and `AXON_CLASSIC_AUTH` is `none`: any host that answers is accepted as
 * a peer.
 */
#define AXON_AUTHENTICATION_NONE 0

/**
 * `classic` and `pinned`: a peer proves a key of the trust file.
 */
#define AXON_AUTHENTICATION_PINNED 1

/**
 * `classic` and `ca`: a peer proves a certificate of the CA.
 */
#define AXON_AUTHENTICATION_CA 2

/**
 * `qkd`: a peer proves a key that the KMEs gave to both hosts.
 */
#define AXON_AUTHENTICATION_QKD 3

/**
 * A timeout value that means without end.
 */
#define AXON_WAIT_FOREVER -1

/**
 * The result of a call: `AXON_RET_OK`, or the reason for the failure.
 */
typedef int32_t axon_ret_t;

/**
 * A node: a name in the graph to which endpoints belong.
 */
typedef struct axon_node_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_node_t;

/**
 * The QoS profile that an endpoint offers or requests. All zeros is the default profile: RELIABLE, VOLATILE,
 * KEEP_LAST(10). A profile that AXON returns for an existing endpoint contains neither defaults nor
 * best-available values.
 */
typedef struct axon_qos_t {
    /**
     * AXON_RELIABILITY_*, or AXON_CHOICE_*.
     */
    uint32_t reliability;
    /**
     * AXON_DURABILITY_*, or AXON_CHOICE_*.
     */
    uint32_t durability;
    /**
     * AXON_HISTORY_*, or AXON_CHOICE_DEFAULT.
     */
    uint32_t history;
    /**
     * The number of samples that KEEP_LAST keeps; 0 for the default.
     */
    uint32_t depth;
    /**
     * AXON_LIVELINESS_*, or AXON_CHOICE_*.
     */
    uint32_t liveliness;
    /**
     * Must be 0.
     */
    uint32_t reserved;
    /**
     * The longest time between two samples, in nanoseconds, or AXON_DURATION_*.
     */
    uint64_t deadline;
    /**
     * The age from which a sample is not delivered any more, in nanoseconds, or AXON_DURATION_*.
     */
    uint64_t lifespan;
    /**
     * The time without an assertion after which a publisher counts as not alive, in nanoseconds, or
     * AXON_DURATION_*.
     */
    uint64_t lease;
} axon_qos_t;

/**
 * The options of a new endpoint. All fields but the two names may be zero.
 */
typedef struct axon_endpoint_options_t {
    /**
     * The full name of the topic or service, of at most 512 bytes. AXON does not interpret the name.
     */
    const char *topic;
    /**
     * The type's name. Endpoints match on topic and type.
     */
    const char *type_name;
    /**
     * The type's hash, of at most AXON_TYPE_HASH_SIZE bytes. If both ends know the hash, the two must be
     * equal.
     */
    const uint8_t *type_hash;
    /**
     * The size of the hash in bytes; 0 if the hash is unknown.
     */
    size_t type_hash_size;
    /**
     * The profile that the endpoint offers or requests.
     */
    struct axon_qos_t qos;
    /**
     * Subscription only: a value other than 0 ignores publishers of the subscription's own session.
     */
    uint8_t ignore_local;
    /**
     * Must be 0.
     */
    uint8_t reserved[3];
    /**
     * Publisher only: the length of most samples in bytes; 0 if unknown. With a length of more than 512, the
     * publisher allocates memory for samples at creation, which each reader maps. Loans of more than 512
     * bytes and all samples of more than 4 KiB are then in place there. Otherwise only samples of more than
     * 4 KiB are in place, in memory that is allocated for the first of them.
     */
    uint32_t expected_len;
} axon_endpoint_options_t;

/**
 * A client, which sends requests to a service.
 */
typedef struct axon_client_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_client_t;

/**
 * The globally unique ID of an endpoint or a node.
 */
typedef struct axon_gid_t {
    /**
     * The bytes in the order in which tools print them.
     */
    uint8_t bytes[16];
} axon_gid_t;

/**
 * A function that returns memory for a message of `len` bytes, or null if there is none. The taking call
 * runs the function. The function must not take a message of the same endpoint.
 */
typedef uint8_t *(*axon_room_t)(void *user, size_t len);

/**
 * The metadata of a message. Times are nanoseconds since the Unix epoch.
 */
typedef struct axon_message_info_t {
    /**
     * The sender: a publisher, the client of a request, or the server of a response.
     */
    struct axon_gid_t sender;
    /**
     * The publication's number, which starts at 1. A response has the number of its request.
     */
    uint64_t publication_sequence;
    /**
     * The message's number among the messages that this endpoint has taken, which starts at 1.
     */
    uint64_t reception_sequence;
    /**
     * The time of sending, by the sender's clock.
     */
    int64_t source_timestamp;
    /**
     * The time of taking, by this host's clock.
     */
    int64_t received_timestamp;
    /**
     * 1 if the sender is an endpoint of the same session, else 0.
     */
    uint8_t own_session;
    /**
     * 0.
     */
    uint8_t reserved[7];
} axon_message_info_t;

/**
 * A sample that was taken in place. `axon_session_sample_release` gives it back.
 */
typedef struct axon_sample_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_sample_t;

/**
 * A function that receives the number of new events: those since its last call, at least one. The session's
 * thread may call the function. Two threads never call it at once. The function must not block. It may call
 * any function of this interface that does not block: it may replace itself, or destroy the object that it
 * was set for.
 */
typedef void (*axon_callback_t)(const void *user, size_t count);

/**
 * A publisher, which sends the samples of a topic.
 */
typedef struct axon_publisher_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_publisher_t;

/**
 * Memory that a publisher lent. The program publishes or abandons the loan.
 */
typedef struct axon_loan_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_loan_t;

/**
 * A server, which answers the requests of a service.
 */
typedef struct axon_server_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_server_t;

/**
 * A subscription, which receives the samples of a topic.
 */
typedef struct axon_subscription_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_subscription_t;

/**
 * One event of a publisher or a subscription.
 */
typedef struct axon_event_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_event_t;

/**
 * The status of an event. Each change is counted since the status was last taken.
 */
typedef struct axon_event_status_t {
    /**
     * AXON_EVENT_*.
     */
    uint32_t kind;
    /**
     * Incompatible QoS: AXON_POLICY_* of a policy that kept the last endpoint from matching.
     */
    uint32_t last_policy;
    /**
     * How often the event happened. For `matched`: the endpoints that were ever matched.
     */
    uint64_t total;
    /**
     * The change of `total`.
     */
    uint64_t total_change;
    /**
     * For `matched`: the endpoints that are matched now. For liveliness changed: the publishers that are
     * alive now.
     */
    uint64_t current;
    /**
     * The change of `current`.
     */
    int64_t current_change;
    /**
     * For liveliness changed: the publishers that are matched and not alive now.
     */
    uint64_t not_alive;
    /**
     * The change of `not_alive`.
     */
    int64_t not_alive_change;
} axon_event_status_t;

/**
 * A session: a process's membership of a domain. `axon_session_close` destroys the handle.
 */
typedef struct axon_session_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_session_t;

/**
 * A function that receives one node.
 */
typedef void (*axon_node_visitor_t)(void *user,
                                    const char *name,
                                    const char *namespace_,
                                    const char *enclave);

/**
 * A function that receives the name of one topic or service, and the types of its endpoints: at least one.
 */
typedef void (*axon_name_visitor_t)(void *user,
                                    const char *name,
                                    const char *const *types,
                                    size_t type_count);

/**
 * An endpoint of the graph. Its pointers are valid during the call of the visitor.
 */
typedef struct axon_endpoint_t {
    /**
     * The endpoint's GID.
     */
    struct axon_gid_t gid;
    /**
     * AXON_KIND_*.
     */
    uint32_t kind;
    /**
     * 1 if the endpoint is on another host, else 0.
     */
    uint32_t remote;
    /**
     * The name of the topic or service.
     */
    const char *topic;
    /**
     * The type's name.
     */
    const char *type_name;
    /**
     * The type's hash.
     */
    const uint8_t *type_hash;
    /**
     * The length of the type's hash in bytes; 0 if the hash is unknown.
     */
    size_t type_hash_size;
    /**
     * The profile that the endpoint offers or requests.
     */
    struct axon_qos_t qos;
    /**
     * The name of the endpoint's node; empty if the endpoint has no node.
     */
    const char *node;
    /**
     * The namespace of the node.
     */
    const char *namespace_;
} axon_endpoint_t;

/**
 * A function that receives one endpoint.
 */
typedef void (*axon_endpoint_visitor_t)(void *user, const struct axon_endpoint_t *endpoint);

/**
 * A function that receives one log line: its severity (AXON_LOG_*), the part of the library that logs it,
 * and the text. Both strings are valid during the call. A text has no line breaks: characters that could
 * control a terminal are escaped, as in the daemon's log.
 *
 * The library calls the function on a thread of its own, for one line after the other. The thread starts
 * with the first line. It has no other work and holds no lock that the program may wait for. Therefore the
 * function may block and may call this interface. Up to 256 lines are queued meanwhile. A full
 * queue drops the line of the lowest severity, and reports the number of dropped lines at the severity of the
 * most severe of them. Lines that the library logs on this thread during the function are dropped.
 */
typedef void (*axon_log_t)(const void *user, uint32_t severity, const char *part, const char *text);

/**
 * A guard condition. It stays set from its trigger until a wait has reported it.
 */
typedef struct axon_guard_t {
    /**
     * 0 if the handle names no object.
     */
    uint64_t id;
} axon_guard_t;

/**
 * The options of a session. Fill them in with `axon_session_options_init`, then change individual fields.
 * The environment and `axon.toml` give all other settings.
 */
typedef struct axon_session_options_t {
    /**
     * The interface version that the program was compiled against.
     */
    uint32_t abi;
    /**
     * 0 to 232, or AXON_DOMAIN_ENVIRONMENT.
     */
    uint32_t domain;
    /**
     * AXON_DISCOVERY_*: the discovery range of the session. It does not depend on the process that started
     * the daemon.
     */
    uint32_t discovery;
    /**
     * Must be 0.
     */
    uint32_t reserved;
    /**
     * Addresses or host names of other hosts, for any discovery but AXON_DISCOVERY_ENVIRONMENT.
     */
    const char *const *static_peers;
    /**
     * The number of static peers.
     */
    size_t static_peer_count;
    /**
     * The name of the session in tools; null or empty for the program's name.
     */
    const char *name;
    /**
     * The path of the daemon's program, used if `AXON_DAEMON_PATH` is not set. The daemon's folder may hold
     * an `axon.toml`, which is read. Null selects `axon_daemon`, else `axon`, in the first of these folders
     * that has one: the folder of this program, that of the library, those in `PATH`, and the folder where
     * cargo installs programs.
     */
    const char *daemon_path;
    /**
     * The file with the permissions of an SROS2 enclave, `permissions.p7s` or `permissions.xml`. The session
     * refuses to create an endpoint that the permissions do not allow (AXON_RET_DENIED). The signature of
     * the file is not verified. Null means no limit. A library that was built without the feature `sros2`
     * accepts only null.
     */
    const char *permissions_path;
    /**
     * The enclave, for instance `/robot/arm`. It must not be null if `permissions_path` is set.
     */
    const char *enclave;
} axon_session_options_t;

/**
 * The handles that a wait includes, in one array for each kind. An empty array may be null. A wait skips
 * handles that are 0.
 */
typedef struct axon_wait_set_t {
    /**
     * Ready while a sample can be taken.
     */
    struct axon_subscription_t *subscriptions;
    /**
     * The number of subscriptions.
     */
    size_t subscription_count;
    /**
     * Ready once triggered. The wait that reports the condition resets it.
     */
    struct axon_guard_t *guards;
    /**
     * The number of guard conditions.
     */
    size_t guard_count;
    /**
     * Ready while a request can be taken.
     */
    struct axon_server_t *servers;
    /**
     * The number of servers.
     */
    size_t server_count;
    /**
     * Ready while a response can be taken.
     */
    struct axon_client_t *clients;
    /**
     * The number of clients.
     */
    size_t client_count;
    /**
     * Ready if the event happened since its status was last taken.
     */
    struct axon_event_t *events;
    /**
     * The number of events.
     */
    size_t event_count;
} axon_wait_set_t;

/**
 * The call succeeded.
 */
#define AXON_RET_OK 0

/**
 * The call failed for a reason without a code of its own. The text of the error states the reason.
 */
#define AXON_RET_ERROR 1

/**
 * The call timed out.
 */
#define AXON_RET_TIMEOUT 2

/**
 * An argument is null although it must not be, not UTF-8, or out of bounds.
 */
#define AXON_RET_INVALID_ARGUMENT 3

/**
 * A handle names no object: the handle is 0, was destroyed, or is of another kind.
 */
#define AXON_RET_INVALID_HANDLE 4

/**
 * Memory, file descriptors or handles are short: of the process, of the host's shared memory, or of the publisher,
 * whose loans and readers hold the rest.
 */
#define AXON_RET_BAD_ALLOC 5

/**
 * A setting is wrong. The text of the error names the variable.
 */
#define AXON_RET_CONFIG 6

/**
 * The handle belongs to the parent of this forked process. The child must open a session of its own.
 */
#define AXON_RET_FORKED 7

/**
 * The program was compiled against another version of the header than the library's.
 */
#define AXON_RET_ABI 8

/**
 * The graph has no node of that name.
 */
#define AXON_RET_NO_NODE 9

/**
 * The library caught a panic: a defect of AXON. The call may have done part of its work.
 */
#define AXON_RET_PANIC 10

/**
 * The permissions of the session's enclave do not allow the endpoint. The text of the error names the topic,
 * the enclave, the file and the line in the file.
 */
#define AXON_RET_DENIED 11

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * Returns the interface version of the library. `axon_session_options_init` compares it with the version of
 * the header and fails if the two differ, so that no session is opened.
 */
uint32_t axon_session_abi(void);

/**
 * Creates a client in a node. `topic` in the options is the service's name. A KEEP_LAST client keeps the
 * newest untaken responses of each server, as many as its depth; a KEEP_ALL client keeps all. When the call
 * returns, the client is matched with the servers in the graph, unless that takes longer than 50 ms or many
 * endpoints are created in a row.
 *
 * Returns the same codes as `axon_session_publisher_create`.
 *
 * # Safety
 * `options` points to options whose pointers point to valid data. `client` points to room for a handle.
 */
axon_ret_t axon_session_client_create(struct axon_node_t node,
                                      const struct axon_endpoint_options_t *options,
                                      struct axon_client_t *client);

/**
 * Destroys a client. When the call returns, the client's callback has returned and is not called again.
 */
axon_ret_t axon_session_client_destroy(struct axon_client_t client);

/**
 * Stores the client's GID, and its profile for requests and responses. A null pointer skips its value.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for their value.
 */
axon_ret_t axon_session_client_describe(struct axon_client_t client,
                                        struct axon_gid_t *gid,
                                        struct axon_qos_t *qos);

/**
 * Counts the servers that receive a request sent now and whose responses reach the client. The service is
 * available if there is at least one.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_client_matched(struct axon_client_t client,
                                       size_t *count);

/**
 * Blocks until the service is available, for at most `timeout` nanoseconds (negative: without end).
 * AXON_RET_TIMEOUT: the service did not become available.
 */
axon_ret_t axon_session_client_wait_available(struct axon_client_t client, int64_t timeout);

/**
 * Sends a request to every matched server. Copies the `len` bytes at `data`. Stores the request's number,
 * which starts at 1, at `sequence`, which may be null. Without a server no response will arrive.
 *
 * May block for 100 ms if a server does not take its requests. AXON_RET_TIMEOUT: the server made no room.
 * All other results are those of `axon_session_publisher_publish`.
 *
 * # Safety
 * `data` points to `len` bytes, or is null and `len` 0; `sequence` is null or points to room for a
 * number.
 */
axon_ret_t axon_session_client_request(struct axon_client_t client,
                                       const uint8_t *data,
                                       size_t len,
                                       uint64_t *sequence);

/**
 * Copies the next response to the memory that `room` returns, as `axon_session_subscription_take` does. The
 * publication's number in `info` is the number of the request.
 *
 * # Safety
 * As for `axon_session_subscription_take`.
 */
axon_ret_t axon_session_client_take(struct axon_client_t client,
                                    axon_room_t room,
                                    void *user,
                                    struct axon_message_info_t *info,
                                    uint8_t *taken);

/**
 * Takes the next response in place, as `axon_session_subscription_take_sample` does.
 *
 * # Safety
 * As for `axon_session_subscription_take_sample`.
 */
axon_ret_t axon_session_client_take_sample(struct axon_client_t client,
                                           struct axon_sample_t *sample,
                                           const uint8_t **data,
                                           size_t *len,
                                           struct axon_message_info_t *info);

/**
 * Sets the callback for new responses, as `axon_session_subscription_set_callback` does.
 *
 * # Safety
 * As for `axon_session_subscription_set_callback`.
 */
axon_ret_t axon_session_client_set_callback(struct axon_client_t client,
                                            axon_callback_t callback,
                                            const void *user);

/**
 * Lends `len` bytes of memory at `data`, which the program writes and then publishes. The memory is shared
 * memory if `len` is more than 4 KiB, or more than 512 bytes for a publisher that expects samples of more
 * than 512 bytes. Such a sample is published without a copy. The bytes hold zeros or data of earlier
 * samples.
 *
 * The byte after the first `header` bytes is aligned to 16, both here and where the sample is taken in
 * place. Pass 0 to align the whole sample, or 4 for a structure that follows a header of four bytes. The
 * program may publish fewer than `len` bytes, so `len` can be an upper bound of the serialized size. Blocks
 * and fails as `axon_session_publisher_publish` does.
 *
 * One thread at a time may write. The bytes may be used until the loan is published or abandoned. The
 * publisher loses the memory of a loan that is neither published nor abandoned. A forked child may not use
 * the bytes.
 *
 * # Safety
 * `loan` points to room for a handle, and `data` to room for a pointer.
 */
axon_ret_t axon_session_publisher_loan(struct axon_publisher_t publisher,
                                       size_t header,
                                       size_t len,
                                       struct axon_loan_t *loan,
                                       uint8_t **data);

/**
 * Publishes the first `len` bytes of a loan, as `axon_session_publisher_publish` does. The loan ends with
 * every result except AXON_RET_INVALID_ARGUMENT: `len` is more than was lent.
 *
 * # Safety
 * `sequence` is null or points to room for a number. No code uses the loan's bytes from now on.
 */
axon_ret_t axon_session_loan_publish(struct axon_loan_t loan,
                                     size_t len,
                                     int64_t source_timestamp,
                                     uint64_t *sequence);

/**
 * Gives a loan back without publishing it.
 */
axon_ret_t axon_session_loan_abandon(struct axon_loan_t loan);

/**
 * Creates a publisher in a node. When the call returns, the publisher is matched with the subscriptions in
 * the graph, unless that takes longer than 50 ms, or new endpoints of the session waited for 100 ms lately: from
 * then on they wait for a tenth of the time.
 *
 * AXON_RET_INVALID_ARGUMENT: a name, the hash or a policy is out of bounds. AXON_RET_BAD_ALLOC: shared
 * memory is short. AXON_RET_DENIED: the session's permissions do not allow the endpoint.
 *
 * # Safety
 * `options` points to options whose pointers point to valid data. `publisher` points to room for a handle.
 */
axon_ret_t axon_session_publisher_create(struct axon_node_t node,
                                         const struct axon_endpoint_options_t *options,
                                         struct axon_publisher_t *publisher);

/**
 * Destroys a publisher. Subscriptions can still take its remaining samples. Its loans can then only be
 * abandoned.
 */
axon_ret_t axon_session_publisher_destroy(struct axon_publisher_t publisher);

/**
 * Stores the publisher's GID and profile. A null pointer skips its value.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for their value.
 */
axon_ret_t axon_session_publisher_describe(struct axon_publisher_t publisher,
                                           struct axon_gid_t *gid,
                                           struct axon_qos_t *qos);

/**
 * Publishes a sample. Copies the `len` bytes at `data`. `source_timestamp` is in nanoseconds since the Unix
 * epoch, or AXON_TIME_NOW. Stores the sample's sequence number, which starts at 1, at `sequence`, which may
 * be null.
 *
 * The call may block for up to 100 ms if the publisher and a subscription are both RELIABLE and KEEP_ALL and
 * the subscription has no room. It never blocks otherwise. AXON_RET_TIMEOUT: the subscription's history
 * stayed full. AXON_RET_BAD_ALLOC: memory is short, or loans and subscriptions hold all memory of the
 * publisher. AXON_RET_INVALID_ARGUMENT: the sample is longer than `AXON_MAX_MESSAGE_MB` allows. A refused
 * sample gets no sequence number, so no subscription counts it as lost.
 *
 * # Safety
 * `data` points to `len` bytes, or is null and `len` 0; `sequence` is null or points to room for a
 * number.
 */
axon_ret_t axon_session_publisher_publish(struct axon_publisher_t publisher,
                                          const uint8_t *data,
                                          size_t len,
                                          int64_t source_timestamp,
                                          uint64_t *sequence);

/**
 * Skips a sample that no subscription would read, now or later: uses up the next sequence number and stores
 * it at `sequence`. Stores 0 if a subscription would read the sample. Publishing without readers has the
 * same effect, but this call saves the caller the work of serializing first.
 *
 * # Safety
 * `sequence` points to room for a number.
 */
axon_ret_t axon_session_publisher_skip_unread(struct axon_publisher_t publisher,
                                              uint64_t *sequence);

/**
 * Counts the subscriptions on this and other hosts that receive from the publisher.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_publisher_matched(struct axon_publisher_t publisher, size_t *count);

/**
 * Blocks until at least `count` subscriptions receive from the publisher, for at most `timeout` nanoseconds
 * (negative: without end). AXON_RET_TIMEOUT: fewer subscriptions do.
 */
axon_ret_t axon_session_publisher_wait_matched(struct axon_publisher_t publisher,
                                               size_t count,
                                               int64_t timeout);

/**
 * Blocks until every sample published so far is acknowledged, for at most `timeout` nanoseconds (negative:
 * without end). AXON_RET_TIMEOUT: a sample is not acknowledged.
 *
 * A sample is acknowledged at once between processes of this host that share memory. If they share none
 * (AXON_SHM), this host's daemon carries the sample. If both the publisher and the subscription are RELIABLE
 * and KEEP_ALL, it is acknowledged when the other process has it. Otherwise it is acknowledged when the
 * daemon has it.
 *
 * The meaning for another host depends on the QoS of publisher and subscription:
 *
 * - Both RELIABLE and KEEP_ALL: that host has the sample.
 * - Both RELIABLE, one of them KEEP_LAST: that host has the newest samples, as many as the smaller depth, or
 *   newer ones. Older samples may be missing.
 * - One of them BEST_EFFORT: the sample was sent or dropped.
 *
 * AXON_RET_TIMEOUT comes at once, and once, if samples were given up since the last call: because a link or
 * this host's daemon failed, a host stopped reading, or a limit dropped them.
 */
axon_ret_t axon_session_publisher_wait_acknowledged(struct axon_publisher_t publisher,
                                                    int64_t timeout);

/**
 * Asserts that the publisher is alive. With MANUAL_BY_TOPIC liveliness, every publication asserts it, too.
 * With AUTOMATIC liveliness, the session asserts it.
 */
axon_ret_t axon_session_publisher_assert_liveliness(struct axon_publisher_t publisher);

/**
 * Creates a server in a node. `topic` in the options is the service's name. A KEEP_LAST server keeps the
 * newest untaken requests of each client, as many as its depth; a KEEP_ALL server keeps all. A kept request
 * is never dropped to make room. When the call returns, the server is matched with the clients in the graph,
 * unless that takes longer than 50 ms or many endpoints are created in a row.
 *
 * Returns the same codes as `axon_session_publisher_create`.
 *
 * # Safety
 * `options` points to options whose pointers point to valid data. `server` points to room for a handle.
 */
axon_ret_t axon_session_server_create(struct axon_node_t node,
                                      const struct axon_endpoint_options_t *options,
                                      struct axon_server_t *server);

/**
 * Destroys a server. When the call returns, the server's callback has returned and is not called again.
 */
axon_ret_t axon_session_server_destroy(struct axon_server_t server);

/**
 * Stores the server's GID, and its profile for requests and responses. A null pointer skips its value.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for their value.
 */
axon_ret_t axon_session_server_describe(struct axon_server_t server,
                                        struct axon_gid_t *gid,
                                        struct axon_qos_t *qos);

/**
 * Counts the clients that are matched in both directions: their requests reach the server, and its responses
 * reach them.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_server_matched(struct axon_server_t server,
                                       size_t *count);

/**
 * Copies the next request to the memory that `room` returns, as `axon_session_subscription_take` does. The
 * response must carry the sender and the publication's number in `info`.
 *
 * # Safety
 * As for `axon_session_subscription_take`.
 */
axon_ret_t axon_session_server_take(struct axon_server_t server,
                                    axon_room_t room,
                                    void *user,
                                    struct axon_message_info_t *info,
                                    uint8_t *taken);

/**
 * Takes the next request in place, as `axon_session_subscription_take_sample` does.
 *
 * # Safety
 * As for `axon_session_subscription_take_sample`.
 */
axon_ret_t axon_session_server_take_sample(struct axon_server_t server,
                                           struct axon_sample_t *sample,
                                           const uint8_t **data,
                                           size_t *len,
                                           struct axon_message_info_t *info);

/**
 * Answers request `sequence` of `client`. Copies the `len` bytes at `data`. Only this client receives the
 * response. A client that no longer exists is no error.
 *
 * May block for 100 ms if the client does not take its responses. AXON_RET_TIMEOUT: the client made no room.
 * All other results are those of `axon_session_publisher_publish`.
 *
 * # Safety
 * `client` points to a GID; `data` points to `len` bytes, or is null and `len` 0.
 */
axon_ret_t axon_session_server_respond(struct axon_server_t server,
                                       const struct axon_gid_t *client,
                                       uint64_t sequence,
                                       const uint8_t *data,
                                       size_t len);

/**
 * Answers as `axon_session_server_respond` does, with the caller's `source_timestamp`: nanoseconds since the
 * Unix epoch, or AXON_TIME_NOW.
 *
 * # Safety
 * As for `axon_session_server_respond`.
 */
axon_ret_t axon_session_server_respond_at(struct axon_server_t server,
                                          const struct axon_gid_t *client,
                                          uint64_t sequence,
                                          int64_t source_timestamp,
                                          const uint8_t *data,
                                          size_t len);

/**
 * Sets the callback for new requests, as `axon_session_subscription_set_callback` does.
 *
 * # Safety
 * As for `axon_session_subscription_set_callback`.
 */
axon_ret_t axon_session_server_set_callback(struct axon_server_t server,
                                            axon_callback_t callback,
                                            const void *user);

/**
 * Creates a subscription in a node. When the call returns, the subscription is matched with the publishers
 * in the graph, unless that takes longer than 50 ms or many endpoints are created in a row. Content filters do
 * not exist.
 *
 * Returns the same codes as `axon_session_publisher_create`.
 *
 * # Safety
 * `options` points to options whose pointers point to valid data. `subscription` points to room for a
 * handle.
 */
axon_ret_t axon_session_subscription_create(struct axon_node_t node,
                                            const struct axon_endpoint_options_t *options,
                                            struct axon_subscription_t *subscription);

/**
 * Destroys a subscription. Samples that were taken in place stay valid until they are released. When the
 * call returns, the subscription's callback has returned and is not called again.
 */
axon_ret_t axon_session_subscription_destroy(struct axon_subscription_t subscription);

/**
 * Stores the subscription's GID and profile. A null pointer skips its value.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for their value.
 */
axon_ret_t axon_session_subscription_describe(struct axon_subscription_t subscription,
                                              struct axon_gid_t *gid,
                                              struct axon_qos_t *qos);

/**
 * Counts the publishers on this and other hosts that the subscription receives from.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_subscription_matched(struct axon_subscription_t subscription,
                                             size_t *count);

/**
 * Blocks until the subscription receives from at least `count` publishers, for at most `timeout` nanoseconds
 * (negative: without end). AXON_RET_TIMEOUT: it receives from fewer.
 */
axon_ret_t axon_session_subscription_wait_matched(struct axon_subscription_t subscription,
                                                  size_t count,
                                                  int64_t timeout);

/**
 * Copies the oldest sample, by source timestamp among all publishers, to the memory that `room` returns.
 * Stores its metadata at `info`, which may be null. Stores 1 at `taken`, or 0 if there was no sample; then
 * `room` is not called. A publisher's sample may be in memory that this process has not received yet, for
 * instance the first sample of more than 4 KiB. Such a sample does not delay the samples of other
 * publishers.
 *
 * AXON_RET_BAD_ALLOC: `room` returned no memory; the sample is lost.
 *
 * # Safety
 * `room` returns null, or memory for as many bytes as it is asked for. `info` is null or points to room for
 * the metadata. `taken` points to room for a number.
 */
axon_ret_t axon_session_subscription_take(struct axon_subscription_t subscription,
                                          axon_room_t room,
                                          void *user,
                                          struct axon_message_info_t *info,
                                          uint8_t *taken);

/**
 * Takes the oldest sample, by source timestamp among all publishers, in place. The `len` bytes at `data` are
 * valid until `axon_session_sample_release`. If there is no sample, the handle is 0 and nothing else is
 * stored.
 *
 * A sample of more than 4 KiB is in the publisher's memory. So is a loan of more than 512 bytes if its
 * publisher expects samples of more than 512 bytes. A subscription can keep five such samples of each
 * publisher; a sixth is copied. A lent sample has the alignment of its loan. A copy has the alignment of the
 * allocator, at least 8; a copy of 0 bytes has any address. Samples of a publisher that violates the
 * protocol may have any alignment.
 *
 * No code may write to the bytes, and a forked child may not read them. A publisher in another process that
 * violates the protocol could change the bytes meanwhile. Therefore a parser should read each byte once and
 * check the value that it read. `AXON_SHM_COPY=1` makes the library copy all samples.
 *
 * # Safety
 * `sample`, `data` and `len` point to room for one value each. `info` is null or points to room for the
 * metadata.
 */
axon_ret_t axon_session_subscription_take_sample(struct axon_subscription_t subscription,
                                                 struct axon_sample_t *sample,
                                                 const uint8_t **data,
                                                 size_t *len,
                                                 struct axon_message_info_t *info);

/**
 * Releases a sample that a subscription, a server or a client took in place. The release may come after the
 * end of that endpoint.
 */
axon_ret_t axon_session_sample_release(struct axon_sample_t sample);

/**
 * Stores the number of samples that the subscription lost: samples that were overwritten before they were
 * taken, or lost on the way from another host.
 *
 * # Safety
 * `lost` points to room for a number.
 */
axon_ret_t axon_session_subscription_lost(struct axon_subscription_t subscription,
                                          uint64_t *lost);

/**
 * Sets the callback for new samples, which replaces the previous callback. When the call returns, the
 * previous callback has returned and is not called again, unless the call comes from inside that callback.
 * Null removes the callback. The call reports untaken samples at once that no callback was called for. The
 * session's thread reports later samples.
 *
 * AXON_RET_ERROR: an event loop of the program already listens to the session.
 *
 * # Safety
 * `callback` may be called with `user` from any thread until the callback is replaced or the subscription is
 * destroyed.
 */
axon_ret_t axon_session_subscription_set_callback(struct axon_subscription_t subscription,
                                                  axon_callback_t callback,
                                                  const void *user);

/**
 * Returns the text of the last failed call in this thread: the failed operation, its topic and node, the
 * cause, and the remedy. The text is empty if no call failed. It stays valid until the next failed call in
 * this thread. A thread that is ending gets null.
 */
const char *axon_session_last_error(void);

/**
 * Creates a handle for one event of a publisher. AXON_RET_INVALID_ARGUMENT: a publisher has no event of this
 * `kind`. The handle stays valid after the publisher ends. The event does not happen again then.
 *
 * # Safety
 * `event` points to room for a handle.
 */
axon_ret_t axon_session_publisher_event(struct axon_publisher_t publisher,
                                        uint32_t kind,
                                        struct axon_event_t *event);

/**
 * Creates a handle for one event of a subscription, as `axon_session_publisher_event` does.
 *
 * # Safety
 * As for `axon_session_publisher_event`.
 */
axon_ret_t axon_session_subscription_event(struct axon_subscription_t subscription,
                                           uint32_t kind,
                                           struct axon_event_t *event);

/**
 * Destroys the handle of an event. When the call returns, the callback of this handle has returned and is
 * not called again. The callbacks of other handles of the same event stay set.
 */
axon_ret_t axon_session_event_destroy(struct axon_event_t event);

/**
 * Takes the status of an event. The changes are counted from 0 again. The event is not ready until it
 * happens again.
 *
 * # Safety
 * `status` points to room for one status.
 */
axon_ret_t axon_session_event_take(struct axon_event_t event,
                                   struct axon_event_status_t *status);

/**
 * Sets the callback of this handle, which replaces the handle's previous callback. When the call returns,
 * the previous callback has returned and is not called again, unless the call comes from inside that
 * callback. Null removes the callback.
 *
 * The call reports the earlier occurrences at once: those since the status was last taken that this handle
 * has not reported yet.
 *
 * # Safety
 * `callback` may be called with `user` from any thread until the callback is replaced or the event is
 * destroyed.
 */
axon_ret_t axon_session_event_set_callback(struct axon_event_t event,
                                           axon_callback_t callback,
                                           const void *user);

/**
 * Calls `visitor` with every node of the graph, in order of namespace and name. Several nodes of the same
 * name give one call each. The strings are valid until the visitor returns. The library holds no lock during
 * the call of the visitor.
 *
 * # Safety
 * `visitor` may be called with `user`.
 */
axon_ret_t axon_session_graph_nodes(struct axon_session_t session,
                                    axon_node_visitor_t visitor,
                                    void *user);

/**
 * Calls `visitor` with the topic and service names of the endpoints of the given kinds (the sum of
 * AXON_KIND_*), in order, each with its types. Null for `node` selects all endpoints. Otherwise the
 * endpoints of the node with this name and namespace are selected.
 *
 * AXON_RET_NO_NODE: the graph has no such node.
 *
 * # Safety
 * `node` and `namespace_` are strings, or `node` is null; `visitor` may be called with `user`.
 */
axon_ret_t axon_session_graph_names(struct axon_session_t session,
                                    uint32_t kinds,
                                    const char *node,
                                    const char *namespace_,
                                    axon_name_visitor_t visitor,
                                    void *user);

/**
 * Calls `visitor` with every endpoint of a kind (AXON_KIND_*) that has this topic or service name. Null for
 * `topic` selects all endpoints of the kind.
 *
 * # Safety
 * `topic` is null or a string; `visitor` may be called with `user`.
 */
axon_ret_t axon_session_graph_endpoints(struct axon_session_t session,
                                        uint32_t kind,
                                        const char *topic,
                                        axon_endpoint_visitor_t visitor,
                                        void *user);

/**
 * Counts the endpoints of a kind (AXON_KIND_*) that have this topic or service name. A publisher or
 * subscription of another process counts once its pairs with the session's own endpoints are attached, at most a
 * second after it was announced. So a sample that is published after the count reaches every counted subscription
 * with a compatible profile, unless its process is stopped. For services, `axon_session_client_matched` tells more.
 *
 * # Safety
 * `topic` is a string; `count` points to room for a number.
 */
axon_ret_t axon_session_graph_count(struct axon_session_t session,
                                    uint32_t kind,
                                    const char *topic,
                                    size_t *count);

/**
 * Sets the callback for the log lines of the library in this process, which replaces the previous one. The
 * call blocks until the previous callback has returned; that one is not called again. Setting the current
 * callback with the same `user` changes nothing and does not block. Null removes the callback; there is none
 * at first. A daemon has a log of its own. A forked child must set a callback for its own log lines.
 *
 * AXON_RET_ERROR: the call comes from inside a callback, or Rust code in the program already receives the
 * log lines (a global `tracing` subscriber).
 *
 * # Safety
 * `callback` may be called with `user` from any thread until it is replaced.
 */
axon_ret_t axon_session_log_set_callback(axon_log_t callback,
                                         const void *user);

/**
 * Sets the lowest severity that is reported, which is AXON_LOG_WARN at first. Values between the named
 * severities are accepted.
 */
axon_ret_t axon_session_log_set_severity(uint32_t severity);

/**
 * Creates a node, which stays in the graph until it is destroyed. Its endpoints do not end with the node.
 * Two nodes may have the same name. A node keeps its session open.
 *
 * AXON_RET_INVALID_ARGUMENT: the name is empty, or a name is longer than 512 bytes.
 *
 * # Safety
 * The three names are strings; `node` points to room for a handle.
 */
axon_ret_t axon_session_node_create(struct axon_session_t session,
                                    const char *name,
                                    const char *namespace_,
                                    const char *enclave,
                                    struct axon_node_t *node);

/**
 * Removes a node from the graph. The call may block for milliseconds, as `axon_session_close` may.
 */
axon_ret_t axon_session_node_destroy(struct axon_node_t node);

/**
 * Creates a handle for the guard condition of the graph. Every change of the graph triggers the condition,
 * once graph queries return the new state. The condition is also triggered when a service or a client of the
 * session finds or loses its other end. The program must destroy the handle, as one that it created. The
 * condition lasts as long as the session.
 *
 * # Safety
 * `guard` points to room for a handle.
 */
axon_ret_t axon_session_node_graph_guard(struct axon_node_t node,
                                         struct axon_guard_t *guard);

/**
 * Checks whether a publisher that offers one profile matches a subscription that requests the other. The
 * result, AXON_QOS_*, is stored at `verdict`. The reason for a result other than AXON_QOS_COMPATIBLE is
 * stored at `reason` as text, cut to `reason_size` bytes with the 0 at its end. Null and 0 mean that no
 * reason is wanted.
 *
 * # Safety
 * `offered` and `requested` point to one profile each. `verdict` points to room for a number, and `reason`
 * to room for `reason_size` bytes.
 */
axon_ret_t axon_session_qos_check(const struct axon_qos_t *offered,
                                  const struct axon_qos_t *requested,
                                  uint32_t *verdict,
                                  char *reason,
                                  size_t reason_size);

/**
 * Returns the name of a policy as ROS 2 spells it, for instance `RELIABILITY`; null if no policy has that
 * number. The string is static.
 */
const char *axon_session_policy_name(uint32_t policy);

/**
 * Fills in options with the defaults. `abi` is the program's AXON_SESSION_ABI. AXON_RET_ABI: the library has
 * another version; the call has written nothing.
 *
 * # Safety
 * `options` points to room for options as the program's header declares them.
 */
axon_ret_t axon_session_options_init(struct axon_session_options_t *options,
                                     uint32_t abi);

/**
 * Checks the settings as `axon_session_open` does, without opening a session.
 *
 * AXON_RET_CONFIG: a setting is wrong. The text of the error names the variable, the value, and the accepted
 * values.
 *
 * # Safety
 * As for `axon_session_open`.
 */
axon_ret_t axon_session_options_check(const struct axon_session_options_t *options);

/**
 * Stores how a session with these options authenticates other hosts: AXON_AUTHENTICATION_*, according to the
 * environment and `axon.toml`. Opens no session.
 *
 * AXON_RET_CONFIG: a setting is wrong, as for `axon_session_options_check`.
 *
 * # Safety
 * As for `axon_session_open`; `authentication` points to room for a number.
 */
axon_ret_t axon_session_options_authentication(const struct axon_session_options_t *options,
                                               uint32_t *authentication);

/**
 * Opens a session. Starts a daemon if none runs and `AXON_DAEMON` permits it. A process may have any number
 * of sessions.
 *
 * Blocks until the daemon answers: for milliseconds, or up to 20 s if the call starts a daemon.
 *
 * AXON_RET_CONFIG: a setting is wrong, or the running daemon has other security settings; the text names the
 * variable. AXON_RET_CONFIG also means that the permissions cannot be read, are not valid now, or allow
 * nothing in the session's domain; the text names the file. AXON_RET_ERROR: no daemon runs and none can be
 * started, or the daemon does not answer. AXON_RET_BAD_ALLOC: shared memory is short.
 *
 * # Safety
 * `options` points to options that `axon_session_options_init` filled in. Each of their pointers is null or
 * points to valid data. `session` points to room for a handle.
 */
axon_ret_t axon_session_open(const struct axon_session_options_t *options,
                             struct axon_session_t *session);

/**
 * Destroys the handle of a session. The session ends when its last node, endpoint and event is destroyed and
 * the last call that uses one of them returns. That call blocks for milliseconds while the session's thread
 * ends.
 */
axon_ret_t axon_session_close(struct axon_session_t session);

/**
 * Stores the domain of the session.
 *
 * # Safety
 * `domain` points to room for a number.
 */
axon_ret_t axon_session_domain(struct axon_session_t session, uint32_t *domain);

/**
 * Stores 1 if the session is connected to a daemon, else 0. A session is not connected after its daemon has
 * died, until another daemon takes over. If `AXON_DAEMON` is `off`, the result is always 1. Data flows
 * between attached endpoints in both cases.
 *
 * # Safety
 * `connected` points to room for a number.
 */
axon_ret_t axon_session_is_connected(struct axon_session_t session,
                                     uint8_t *connected);

/**
 * Creates a guard condition for a session. It does not keep the session open. After the session has ended,
 * the condition can still be triggered and destroyed, but no wait can include it.
 *
 * # Safety
 * `guard` points to room for a handle.
 */
axon_ret_t axon_session_guard_create(struct axon_session_t session,
                                     struct axon_guard_t *guard);

/**
 * Destroys the handle of a guard condition. A running wait continues without the condition.
 */
axon_ret_t axon_session_guard_destroy(struct axon_guard_t guard);

/**
 * Triggers a guard condition. The call is async-signal-safe: it takes no lock and allocates no memory. It
 * changes neither errno nor the text of the last error.
 *
 * AXON_RET_INVALID_HANDLE: the handle names no guard condition, or the condition is being destroyed.
 */
axon_ret_t axon_session_guard_trigger(struct axon_guard_t guard);

/**
 * Blocks until at least one handle in `set` is ready, for at most `timeout` nanoseconds. A timeout of 0 does
 * not block. AXON_WAIT_FOREVER, like any negative number, blocks without end, even if the set is empty. The
 * call then sets all handles in the arrays to 0 that are not ready.
 *
 * AXON_RET_TIMEOUT: no handle was ready in time; all handles are 0. Every other failure leaves the arrays
 * unchanged. AXON_RET_INVALID_HANDLE: a handle names no object. AXON_RET_INVALID_ARGUMENT: a handle belongs
 * to another session that is closed. Handles of another open session of this process are permitted; their
 * wake-up takes a detour through one more thread.
 *
 * Any number of threads may wait at once, each with arrays of its own. An object that is destroyed during a
 * wait leaves the graph at once. The wait continues.
 *
 * # Safety
 * `set` points to a set whose arrays hold as many handles as their counts say. No other code uses the arrays
 * during the call.
 */
axon_ret_t axon_session_wait(struct axon_session_t session,
                             const struct axon_wait_set_t *set,
                             int64_t timeout);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* AXON_H */
