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
 * The version of this interface. It rises whenever a program that was compiled against the former
 * header would not work any more.
 */
#define AXON_SESSION_ABI 3

/**
 * The most bytes that the hash of a type may have.
 */
#define AXON_TYPE_HASH_SIZE 64

/**
 * The time at which the call is made, as a sample's source timestamp.
 */
#define AXON_TIME_NOW INT64_MIN

/**
 * Of a subscription: a publisher became alive or ceased to be.
 */
#define AXON_EVENT_LIVELINESS_CHANGED 0

/**
 * Of a subscription: no sample came for longer than its deadline.
 */
#define AXON_EVENT_REQUESTED_DEADLINE_MISSED 1

/**
 * Of a subscription: a publisher offers less than it requests.
 */
#define AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE 2

/**
 * Of a subscription: samples were lost before they could be taken.
 */
#define AXON_EVENT_MESSAGE_LOST 3

/**
 * Of a subscription: a publisher of the topic has another type.
 */
#define AXON_EVENT_SUBSCRIPTION_INCOMPATIBLE_TYPE 4

/**
 * Of a subscription: a publisher was matched or unmatched.
 */
#define AXON_EVENT_SUBSCRIPTION_MATCHED 5

/**
 * Of a publisher: it did not assert its liveliness within its lease.
 */
#define AXON_EVENT_LIVELINESS_LOST 6

/**
 * Of a publisher: it did not publish within its deadline.
 */
#define AXON_EVENT_OFFERED_DEADLINE_MISSED 7

/**
 * Of a publisher: a subscription requests more than it offers.
 */
#define AXON_EVENT_OFFERED_QOS_INCOMPATIBLE 8

/**
 * Of a publisher: a subscription of the topic has another type.
 */
#define AXON_EVENT_PUBLISHER_INCOMPATIBLE_TYPE 9

/**
 * Of a publisher: a subscription was matched or unmatched.
 */
#define AXON_EVENT_PUBLICATION_MATCHED 10

/**
 * A kind of endpoint: publishers.
 */
#define AXON_KIND_PUBLISHER 1

/**
 * Subscriptions.
 */
#define AXON_KIND_SUBSCRIPTION 2

/**
 * Servers.
 */
#define AXON_KIND_SERVER 4

/**
 * Clients.
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
 * Left to AXON, in any policy: RELIABLE, VOLATILE, KEEP_LAST, AUTOMATIC.
 */
#define AXON_CHOICE_DEFAULT 0

/**
 * In reliability, durability and liveliness: what matches most of the endpoints that the graph
 * holds when the endpoint is created, at the highest level that does.
 */
#define AXON_CHOICE_BEST_AVAILABLE 255

/**
 * Samples arrive, within the bounds of the history.
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
 * It receives samples from then on.
 */
#define AXON_DURABILITY_VOLATILE 2

/**
 * The newest `depth` samples are kept.
 */
#define AXON_HISTORY_KEEP_LAST 1

/**
 * All are kept, up to the memory budget; then the publisher waits.
 */
#define AXON_HISTORY_KEEP_ALL 2

/**
 * The session asserts that a publisher is alive.
 */
#define AXON_LIVELINESS_AUTOMATIC 1

/**
 * The publisher does, by publishing or asserting.
 */
#define AXON_LIVELINESS_MANUAL_BY_TOPIC 3

/**
 * A time that is left to AXON, which takes it to be infinite.
 */
#define AXON_DURATION_DEFAULT 0

/**
 * As AXON_CHOICE_BEST_AVAILABLE, for a deadline or a lease.
 */
#define AXON_DURATION_BEST_AVAILABLE 18446744073709551614ull

/**
 * No end.
 */
#define AXON_DURATION_INFINITE 18446744073709551615ull

/**
 * The two profiles go together.
 */
#define AXON_QOS_COMPATIBLE 0

/**
 * That hangs on policies that are left open, as default or as best available.
 */
#define AXON_QOS_UNKNOWN 1

/**
 * They do not.
 */
#define AXON_QOS_INCOMPATIBLE 2

/**
 * No policy.
 */
#define AXON_POLICY_NONE 0

/**
 * Which policy keeps two endpoints apart: reliability.
 */
#define AXON_POLICY_RELIABILITY 1

/**
 * Durability.
 */
#define AXON_POLICY_DURABILITY 2

/**
 * Deadline.
 */
#define AXON_POLICY_DEADLINE 3

/**
 * Liveliness.
 */
#define AXON_POLICY_LIVELINESS 4

/**
 * The liveliness lease.
 */
#define AXON_POLICY_LIVELINESS_LEASE 5

/**
 * The domain is what `ROS_DOMAIN_ID` says, else 0.
 */
#define AXON_DOMAIN_ENVIRONMENT 4294967295

/**
 * Discovery reaches as far as `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS` and
 * `ROS_LOCALHOST_ONLY` say.
 */
#define AXON_DISCOVERY_ENVIRONMENT 0

/**
 * Nowhere: the session reaches its own endpoints alone, static peers or not.
 */
#define AXON_DISCOVERY_OFF 1

/**
 * This host, and other hosts of which either side lists the other as a static peer.
 */
#define AXON_DISCOVERY_LOCALHOST 2

/**
 * What multicast reaches, and static peers.
 */
#define AXON_DISCOVERY_SUBNET 3

/**
 * What multicast reaches; the list is passed over.
 */
#define AXON_DISCOVERY_SYSTEM_DEFAULT 4

/**
 * `AXON_SECURITY_MODE` is `classic` and `AXON_CLASSIC_AUTH` is `none`: any host that answers is a peer.
 */
#define AXON_AUTHENTICATION_NONE 0

/**
 * `classic` and `pinned`: a peer has a key of the trust file.
 */
#define AXON_AUTHENTICATION_PINNED 1

/**
 * `classic` and `ca`: a peer has a certificate of the CA.
 */
#define AXON_AUTHENTICATION_CA 2

/**
 * `qkd`: a peer has a key that the KMEs gave to both.
 */
#define AXON_AUTHENTICATION_QKD 3

/**
 * As a timeout: for ever.
 */
#define AXON_WAIT_FOREVER -1

/**
 * What a call returns: `AXON_RET_OK`, or why it did not do what it was asked.
 */
typedef int32_t axon_ret_t;

/**
 * A node: a name in the graph to which endpoints belong.
 */
typedef struct axon_node_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_node_t;

/**
 * What an endpoint offers or requests. All zeros is the default profile: RELIABLE, VOLATILE,
 * KEEP_LAST(10). What AXON says of an endpoint that there is holds no default and nothing best
 * available.
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
     * Samples kept by KEEP_LAST; 0 is the default.
     */
    uint32_t depth;
    /**
     * AXON_LIVELINESS_*, or AXON_CHOICE_*.
     */
    uint32_t liveliness;
    /**
     * 0.
     */
    uint32_t reserved;
    /**
     * Longest time between two samples, in nanoseconds, or AXON_DURATION_*.
     */
    uint64_t deadline;
    /**
     * Age at which a sample is not delivered any more, in nanoseconds, or AXON_DURATION_*.
     */
    uint64_t lifespan;
    /**
     * Time without an assertion after which a publisher counts as not alive, in nanoseconds, or
     * AXON_DURATION_*.
     */
    uint64_t lease;
} axon_qos_t;

/**
 * What an endpoint is created with. All zeros but the two names is a usual one.
 */
typedef struct axon_endpoint_options_t {
    /**
     * The full name of the topic or service, of at most 512 bytes. AXON gives it no meaning.
     */
    const char *topic;
    /**
     * The type's name. Endpoints match on topic and type.
     */
    const char *type_name;
    /**
     * The type's hash, of at most AXON_TYPE_HASH_SIZE bytes. Where both ends know it, it must be the
     * same.
     */
    const uint8_t *type_hash;
    /**
     * 0: it is not known.
     */
    size_t type_hash_size;
    /**
     * What it offers or requests.
     */
    struct axon_qos_t qos;
    /**
     * A subscription: not 0 to receive nothing from publishers of its own session.
     */
    uint8_t ignore_local;
    /**
     * 0.
     */
    uint8_t reserved[3];
    /**
     * A publisher: the length of most samples in bytes; 0 where it is not known. Where it is more than
     * 512, the publisher has memory of its own for samples from the start, which each reader maps, and
     * loans of more than 512 bytes are in place there, like all samples of more than 4 KiB. Otherwise
     * only the latter are, in memory that comes with the first of them.
     */
    uint32_t expected_len;
} axon_endpoint_options_t;

/**
 * Sends requests to a service.
 */
typedef struct axon_client_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_client_t;

/**
 * Names an endpoint or a node: no other anywhere has the same.
 */
typedef struct axon_gid_t {
    /**
     * In the order in which they are shown.
     */
    uint8_t bytes[16];
} axon_gid_t;

/**
 * Says where a message of `len` bytes is to be put: room for as many, or null where there is none.
 * It runs in the call that takes the message, and must not take one of the same endpoint itself.
 */
typedef uint8_t *(*axon_room_t)(void *user, size_t len);

/**
 * What is known of a message besides its bytes. Times are nanoseconds since the Unix epoch.
 */
typedef struct axon_message_info_t {
    /**
     * Who sent it: a publisher, a client of a request, or a server of a response.
     */
    struct axon_gid_t sender;
    /**
     * The publication's number, from 1; of a response, that of the request that it answers.
     */
    uint64_t publication_sequence;
    /**
     * Its number among the messages that this endpoint has taken, from 1.
     */
    uint64_t reception_sequence;
    /**
     * When it was sent, by the sender's clock.
     */
    int64_t source_timestamp;
    /**
     * When it was taken, by this host's clock.
     */
    int64_t received_timestamp;
    /**
     * 1 where the sender is an endpoint of the same session, else 0.
     */
    uint8_t own_session;
    /**
     * 0.
     */
    uint8_t reserved[7];
} axon_message_info_t;

/**
 * A sample that was taken in place, to be given back by `axon_session_sample_release`.
 */
typedef struct axon_sample_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_sample_t;

/**
 * Told how often something happened since it was told last; at least once. It may be called on the
 * session's thread, but never by two threads at once, must not block, and may call any function of this
 * interface that does not block, also to replace itself or to destroy what it was set for.
 */
typedef void (*axon_callback_t)(const void *user, size_t count);

/**
 * Sends the samples of a topic.
 */
typedef struct axon_publisher_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_publisher_t;

/**
 * Memory that a publisher lent, to be published or abandoned.
 */
typedef struct axon_loan_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_loan_t;

/**
 * Answers the requests of a service.
 */
typedef struct axon_server_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_server_t;

/**
 * Receives the samples of a topic.
 */
typedef struct axon_subscription_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_subscription_t;

/**
 * One event of a publisher or a subscription.
 */
typedef struct axon_event_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_event_t;

/**
 * What is known of an event. Changes are since the status was last taken.
 */
typedef struct axon_event_status_t {
    /**
     * AXON_EVENT_*.
     */
    uint32_t kind;
    /**
     * Of incompatible QoS: AXON_POLICY_*, one that kept the last endpoint apart.
     */
    uint32_t last_policy;
    /**
     * How often it happened in all; of `matched`, endpoints matched ever.
     */
    uint64_t total;
    /**
     * How much of that is new.
     */
    uint64_t total_change;
    /**
     * Of `matched`, endpoints matched now; of liveliness changed, publishers that are alive now.
     */
    uint64_t current;
    /**
     * By how many that changed.
     */
    int64_t current_change;
    /**
     * Of liveliness changed, publishers that are matched and not alive now.
     */
    uint64_t not_alive;
    /**
     * By how many that changed.
     */
    int64_t not_alive_change;
} axon_event_status_t;

/**
 * A session: a process's membership of a domain. Destroyed by `axon_session_close`.
 */
typedef struct axon_session_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_session_t;

/**
 * Told of a node.
 */
typedef void (*axon_node_visitor_t)(void *user,
                                    const char *name,
                                    const char *namespace_,
                                    const char *enclave);

/**
 * Told of a topic or service and the types that its endpoints have, of which there is at least one.
 */
typedef void (*axon_name_visitor_t)(void *user,
                                    const char *name,
                                    const char *const *types,
                                    size_t type_count);

/**
 * An endpoint of the graph. What it points to stands during the call that it is given to.
 */
typedef struct axon_endpoint_t {
    /**
     * Its GID.
     */
    struct axon_gid_t gid;
    /**
     * AXON_KIND_*.
     */
    uint32_t kind;
    /**
     * 1 where it is on another host, else 0.
     */
    uint32_t remote;
    /**
     * The name of its topic or service.
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
     * 0 where it is not known.
     */
    size_t type_hash_size;
    /**
     * What it offers or requests.
     */
    struct axon_qos_t qos;
    /**
     * The node that it belongs to; empty where it belongs to none.
     */
    const char *node;
    /**
     * That node's namespace.
     */
    const char *namespace_;
} axon_endpoint_t;

/**
 * Told of an endpoint.
 */
typedef void (*axon_endpoint_visitor_t)(void *user, const struct axon_endpoint_t *endpoint);

/**
 * Told of a line: how severe it is (AXON_LOG_*), which part of the library says it, and what. Both
 * strings stand during the call. A line is one line: characters that could steer a terminal are escaped,
 * as in the daemon's log. It is called on a thread of the library's own, which begins with the
 * first line, for one line after another. That thread has nothing else to do and holds nothing that the
 * program may wait for, so the callback may block and may call this interface. Meanwhile 256 lines wait;
 * of more only the number is told. What the callback makes the library say on its thread is not told.
 */
typedef void (*axon_log_t)(const void *user, uint32_t severity, const char *part, const char *text);

/**
 * A guard condition: stands from when it is triggered until a wait has seen it.
 */
typedef struct axon_guard_t {
    /**
     * 0 where it is none.
     */
    uint64_t id;
} axon_guard_t;

/**
 * How a session is opened. `axon_session_options_init` fills it in; what is to be otherwise is
 * changed then. Everything that it does not say, the environment and `axon.toml` do.
 */
typedef struct axon_session_options_t {
    /**
     * The interface that the program was compiled against.
     */
    uint32_t abi;
    /**
     * 0 to 232, or AXON_DOMAIN_ENVIRONMENT.
     */
    uint32_t domain;
    /**
     * AXON_DISCOVERY_*: how far the session is discovered, whichever process started the daemon.
     */
    uint32_t discovery;
    /**
     * 0.
     */
    uint32_t reserved;
    /**
     * Addresses or host names of other hosts, for any discovery but AXON_DISCOVERY_ENVIRONMENT.
     */
    const char *const *static_peers;
    /**
     * How many there are.
     */
    size_t static_peer_count;
    /**
     * Shown to people; null or empty: the program's name.
     */
    const char *name;
    /**
     * The daemon's program, where `AXON_DAEMON_PATH` names none. An `axon.toml` beside it is read. Null:
     * `axon_daemon`, else `axon`, in the first of the following folders that has it: this program's own, the
     * library's, those in `PATH`, and the one where cargo installs programs.
     */
    const char *daemon_path;
    /**
     * The file with the permissions of an SROS2 enclave, `permissions.p7s` or `permissions.xml`: the session creates no
     * endpoint that they do not allow (AXON_RET_DENIED). Their signature is not verified. Null: no limit. A library
     * that was built without the feature `sros2` takes null alone.
     */
    const char *permissions_path;
    /**
     * The enclave, as `/robot/arm`. Not null where `permissions_path` is not.
     */
    const char *enclave;
} axon_session_options_t;

/**
 * What to wait for: arrays of handles, each of which may be empty, and then null. A handle that is
 * 0 is passed over.
 */
typedef struct axon_wait_set_t {
    /**
     * Ready while there is something to take.
     */
    struct axon_subscription_t *subscriptions;
    /**
     * How many they are.
     */
    size_t subscription_count;
    /**
     * Ready once it was triggered. The wait that finds it so resets it.
     */
    struct axon_guard_t *guards;
    /**
     * How many they are.
     */
    size_t guard_count;
    /**
     * Ready while there is a request to take.
     */
    struct axon_server_t *servers;
    /**
     * How many they are.
     */
    size_t server_count;
    /**
     * Ready while there is a response to take.
     */
    struct axon_client_t *clients;
    /**
     * How many they are.
     */
    size_t client_count;
    /**
     * Ready while it happened and its status was not taken since.
     */
    struct axon_event_t *events;
    /**
     * How many they are.
     */
    size_t event_count;
} axon_wait_set_t;

/**
 * It worked.
 */
#define AXON_RET_OK 0

/**
 * It did not, for a reason that only the text tells.
 */
#define AXON_RET_ERROR 1

/**
 * The time was over first.
 */
#define AXON_RET_TIMEOUT 2

/**
 * An argument is null where it must not be, not UTF-8, or out of bounds.
 */
#define AXON_RET_INVALID_ARGUMENT 3

/**
 * A handle names nothing: it is 0, was destroyed, or is of another kind.
 */
#define AXON_RET_INVALID_HANDLE 4

/**
 * Memory, descriptors or handles are short.
 */
#define AXON_RET_BAD_ALLOC 5

/**
 * A setting is wrong; the text names the variable.
 */
#define AXON_RET_CONFIG 6

/**
 * The handle belongs to a process of which this one is a fork. A child opens a session of its own.
 */
#define AXON_RET_FORKED 7

/**
 * The program was compiled against another version of this header than the library's.
 */
#define AXON_RET_ABI 8

/**
 * There is no node of that name.
 */
#define AXON_RET_NO_NODE 9

/**
 * A defect of the library was caught. What the call should have done may be half done.
 */
#define AXON_RET_PANIC 10

/**
 * The permissions of the session's enclave do not allow the endpoint; the text names the topic, the
 * enclave, the file and its line.
 */
#define AXON_RET_DENIED 11

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/**
 * The version of the interface that the library has. `axon_session_options_init` compares it with
 * the header's, so that no session is opened where they differ.
 */
uint32_t axon_session_abi(void);

/**
 * A client of a node: `topic` in the options is the service's name. Of responses that were not taken
 * it keeps of each server what a server keeps of each client's requests. When it returns, the client
 * is matched with those servers that the graph shows, unless they take longer than 50 ms.
 *
 * Returns as `axon_session_publisher_create`.
 *
 * # Safety
 * `options` points to options whose pointers point to what they say; `client` points to room for a
 * handle.
 */
axon_ret_t axon_session_client_create(struct axon_node_t node,
                                      const struct axon_endpoint_options_t *options,
                                      struct axon_client_t *client);

/**
 * Ends a client. Its callback has returned, and is not called any more, when this returns.
 */
axon_ret_t axon_session_client_destroy(struct axon_client_t client);

/**
 * What the client is: its GID, and the profile that it has for requests and for responses. Null
 * where one is not wanted.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for one.
 */
axon_ret_t axon_session_client_describe(struct axon_client_t client,
                                        struct axon_gid_t *gid,
                                        struct axon_qos_t *qos);

/**
 * How many servers a request that is sent now reaches, and whose responses reach the client: the
 * service is available where there is one.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_client_matched(struct axon_client_t client, size_t *count);

/**
 * Blocks until the service is available, for at most `timeout` nanoseconds (negative: for ever):
 * AXON_RET_TIMEOUT where it is not.
 */
axon_ret_t axon_session_client_wait_available(struct axon_client_t client, int64_t timeout);

/**
 * Sends a request of `len` bytes at `data`, which are copied, to every server that is there, and
 * stores its number, from 1, at `sequence`, which may be null. Where there is no server, nobody will
 * answer.
 *
 * May block for 100 ms where a server does not take its requests: AXON_RET_TIMEOUT when it made no
 * room. The rest is as for `axon_session_publisher_publish`.
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
 * Copies the next response to where `room` says, as `axon_session_subscription_take`. The
 * publication's number in `info` is that of the request.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_client_take(struct axon_client_t client,
                                    axon_room_t room,
                                    void *user,
                                    struct axon_message_info_t *info,
                                    uint8_t *taken);

/**
 * Takes the next response in place, as `axon_session_subscription_take_sample`.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_client_take_sample(struct axon_client_t client,
                                           struct axon_sample_t *sample,
                                           const uint8_t **data,
                                           size_t *len,
                                           struct axon_message_info_t *info);

/**
 * Has `callback` told of new responses, as `axon_session_subscription_set_callback`.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_client_set_callback(struct axon_client_t client,
                                            axon_callback_t callback,
                                            const void *user);

/**
 * Lends `len` bytes to be written and then published: in shared memory where they are more than
 * 4 KiB, or more than 512 bytes if the publisher was created to expect so many, so that nothing is
 * copied. They are at `data` and hold zeros or bytes of earlier samples.
 * Aligned to 16 is what is behind the first `header` of them, here and where they are taken in place:
 * 0 for all of them, 4 for a structure that follows a header of four bytes. Fewer than `len` may be published, so that what is serialized can be given its
 * upper bound. Blocks and fails as `axon_session_publisher_publish`.
 *
 * One thread at a time may write. The bytes may be used until the loan is published or abandoned;
 * memory of a loan that is neither is lost to the publisher. A forked child may not use them.
 *
 * # Safety
 * `loan` and `data` point to room for a handle and a pointer.
 */
axon_ret_t axon_session_publisher_loan(struct axon_publisher_t publisher,
                                       size_t header,
                                       size_t len,
                                       struct axon_loan_t *loan,
                                       uint8_t **data);

/**
 * Publishes the first `len` bytes of a loan, as `axon_session_publisher_publish` does. The loan is
 * over, whatever this returns, but for AXON_RET_INVALID_ARGUMENT: `len` is more than was lent.
 *
 * # Safety
 * `sequence` is null or points to room for a number. Nobody uses the loan's bytes any more.
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
 * A publisher of a node. When it returns, the publisher is matched with those subscriptions that the
 * graph shows, unless they take longer than 50 ms.
 *
 * AXON_RET_INVALID_ARGUMENT: a name, the hash or a policy is out of bounds. AXON_RET_BAD_ALLOC: shared
 * memory is short. AXON_RET_DENIED: the session's permissions do not allow it.
 *
 * # Safety
 * `options` points to options whose pointers point to what they say; `publisher` points to room for
 * a handle.
 */
axon_ret_t axon_session_publisher_create(struct axon_node_t node,
                                         const struct axon_endpoint_options_t *options,
                                         struct axon_publisher_t *publisher);

/**
 * Ends a publisher. Subscriptions still take what it left. What it lent can only be abandoned then.
 */
axon_ret_t axon_session_publisher_destroy(struct axon_publisher_t publisher);

/**
 * What the publisher is: its GID, and the profile that it has. Null where one is not wanted.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for one.
 */
axon_ret_t axon_session_publisher_describe(struct axon_publisher_t publisher,
                                           struct axon_gid_t *gid,
                                           struct axon_qos_t *qos);

/**
 * Publishes a sample of `len` bytes at `data`, which are copied. `source_timestamp` is in
 * nanoseconds since the Unix epoch, or AXON_TIME_NOW. Its sequence number, from 1, is stored at
 * `sequence`, which may be null.
 *
 * Where the publisher and a subscription are both RELIABLE and KEEP_ALL, it may block for 100 ms until
 * the subscription makes room: AXON_RET_TIMEOUT where its history stayed full, AXON_RET_BAD_ALLOC where
 * memory stayed short. Never else. AXON_RET_BAD_ALLOC: memory is short, or what loans and subscriptions
 * hold fills that of the publisher. AXON_RET_INVALID_ARGUMENT: the sample is longer than
 * `AXON_MAX_MESSAGE_MB` allows. A sample that was refused has no number: nobody counts it lost.
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
 * If a sample would be read by nobody, now or later, uses up the next sequence number and stores it
 * at `sequence`; stores 0 where somebody would. Publishing does the same where nobody reads, but
 * a caller that has to serialize first can save the work.
 *
 * # Safety
 * `sequence` points to room for a number.
 */
axon_ret_t axon_session_publisher_skip_unread(struct axon_publisher_t publisher,
                                              uint64_t *sequence);

/**
 * How many subscriptions receive from the publisher, on this host and on others.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_publisher_matched(struct axon_publisher_t publisher, size_t *count);

/**
 * Blocks until at least `count` subscriptions receive from the publisher, for at most `timeout`
 * nanoseconds (negative: for ever): AXON_RET_TIMEOUT where they do not.
 */
axon_ret_t axon_session_publisher_wait_matched(struct axon_publisher_t publisher,
                                               size_t count,
                                               int64_t timeout);

/**
 * Blocks until every sample published so far is acknowledged, for at most `timeout` nanoseconds
 * (negative: for ever): AXON_RET_TIMEOUT where one is not. Between processes of this host that share
 * memory a sample is acknowledged at once. Where they share none (AXON_SHM), this host's daemon carries it:
 * a sample of a RELIABLE and KEEP_ALL publisher for a subscription like it is acknowledged when the other
 * process has it, any other when the daemon has it. For another host it depends on the QoS of publisher and
 * subscription. Both RELIABLE and KEEP_ALL: that host has the sample. Both RELIABLE, one of them KEEP_LAST:
 * that host has the newest samples, as many as the depth (the smaller one), or newer ones; older ones may be
 * missing. One of them BEST_EFFORT: the sample was sent or dropped. AXON_RET_TIMEOUT comes at once, and
 * once, when samples were given up since the last call: with a link, or with this host's daemon, for a host
 * that read nothing, or by a limit.
 */
axon_ret_t axon_session_publisher_wait_acknowledged(struct axon_publisher_t publisher,
                                                    int64_t timeout);

/**
 * Says that the publisher is alive. Where its liveliness is MANUAL_BY_TOPIC, so does every
 * publication; where it is AUTOMATIC, its session says so.
 */
axon_ret_t axon_session_publisher_assert_liveliness(struct axon_publisher_t publisher);

/**
 * A server of a node: `topic` in the options is the service's name. Of requests that were not taken
 * a KEEP_LAST server keeps the newest of each client, as many as its depth, and a KEEP_ALL one all.
 * What is kept is never dropped to make room. When it returns, the server is matched with those
 * clients that the graph shows, unless they take longer than 50 ms.
 *
 * Returns as `axon_session_publisher_create`.
 *
 * # Safety
 * `options` points to options whose pointers point to what they say; `server` points to room for a
 * handle.
 */
axon_ret_t axon_session_server_create(struct axon_node_t node,
                                      const struct axon_endpoint_options_t *options,
                                      struct axon_server_t *server);

/**
 * Ends a server. Its callback has returned, and is not called any more, when this returns.
 */
axon_ret_t axon_session_server_destroy(struct axon_server_t server);

/**
 * What the server is: its GID, and the profile that it has for requests and for responses. Null
 * where one is not wanted.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for one.
 */
axon_ret_t axon_session_server_describe(struct axon_server_t server,
                                        struct axon_gid_t *gid,
                                        struct axon_qos_t *qos);

/**
 * How many clients reach the server, and are reached by it.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_server_matched(struct axon_server_t server, size_t *count);

/**
 * Copies the next request to where `room` says, as `axon_session_subscription_take`. The sender and
 * the publication's number in `info` are what the response must carry.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_server_take(struct axon_server_t server,
                                    axon_room_t room,
                                    void *user,
                                    struct axon_message_info_t *info,
                                    uint8_t *taken);

/**
 * Takes the next request in place, as `axon_session_subscription_take_sample`.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_server_take_sample(struct axon_server_t server,
                                           struct axon_sample_t *sample,
                                           const uint8_t **data,
                                           size_t *len,
                                           struct axon_message_info_t *info);

/**
 * Answers request `sequence` of `client` with `len` bytes at `data`, which are copied. Nobody else
 * receives it. A client that is gone is no error.
 *
 * May block for 100 ms where the client does not take its responses: AXON_RET_TIMEOUT when it made no
 * room. The rest is as for `axon_session_publisher_publish`.
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
 * Has `callback` told of new requests, as `axon_session_subscription_set_callback`.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_server_set_callback(struct axon_server_t server,
                                            axon_callback_t callback,
                                            const void *user);

/**
 * A subscription of a node. When it returns, the subscription is matched with those publishers that
 * the graph shows, unless they take longer than 50 ms. There are no content filters.
 *
 * Returns as `axon_session_publisher_create`.
 *
 * # Safety
 * `options` points to options whose pointers point to what they say; `subscription` points to room
 * for a handle.
 */
axon_ret_t axon_session_subscription_create(struct axon_node_t node,
                                            const struct axon_endpoint_options_t *options,
                                            struct axon_subscription_t *subscription);

/**
 * Ends a subscription. Samples that were taken in place stay until they are released. Its callback
 * has returned, and is not called any more, when this returns.
 */
axon_ret_t axon_session_subscription_destroy(struct axon_subscription_t subscription);

/**
 * What the subscription is: its GID, and the profile that it has. Null where one is not wanted.
 *
 * # Safety
 * `gid` and `qos` are null or point to room for one.
 */
axon_ret_t axon_session_subscription_describe(struct axon_subscription_t subscription,
                                              struct axon_gid_t *gid,
                                              struct axon_qos_t *qos);

/**
 * How many publishers the subscription receives from, on this host and on others.
 *
 * # Safety
 * `count` points to room for a number.
 */
axon_ret_t axon_session_subscription_matched(struct axon_subscription_t subscription,
                                             size_t *count);

/**
 * Blocks until the subscription receives from at least `count` publishers, for at most `timeout`
 * nanoseconds (negative: for ever): AXON_RET_TIMEOUT where it does not.
 */
axon_ret_t axon_session_subscription_wait_matched(struct axon_subscription_t subscription,
                                                  size_t count,
                                                  int64_t timeout);

/**
 * Copies the oldest sample, by source timestamp among all publishers, to where `room` says, and
 * stores what is known of it at `info`, which may be null. `taken` is 0 where there was none, and
 * then `room` is not called. A publisher whose sample is in memory that this process has not been told
 * of yet, such as its first one of more than 4 KiB, holds up none of the others.
 *
 * AXON_RET_BAD_ALLOC: `room` gave none; the sample is gone.
 *
 * # Safety
 * `room` gives null, or room for as many bytes as it is asked for; `info` is null or points to room
 * for one; `taken` points to room for a number.
 */
axon_ret_t axon_session_subscription_take(struct axon_subscription_t subscription,
                                          axon_room_t room,
                                          void *user,
                                          struct axon_message_info_t *info,
                                          uint8_t *taken);

/**
 * Takes the oldest sample, by source timestamp among all publishers, in place: `len` bytes at `data`,
 * which stand until `axon_session_sample_release`. What was lent is aligned as it was, a copy as
 * the allocator does it (to 8 at least, but for one of 0 bytes, of which `data` is any address), and what a
 * publisher wrote that does not keep to the protocol anyhow. One of more than 4 KiB, and a loan of more
 * than 512 bytes whose publisher expects so many, is in the publisher's memory, of which a subscription
 * can keep five for each publisher; a sixth is copied.
 * Where there is none the handle is 0, and nothing else is stored.
 *
 * Nobody may write to the bytes, and a forked child may not read them. Such a publisher, in another
 * process, could change them meanwhile: a parser reads each byte once, and checks what it read.
 * `AXON_SHM_COPY=1` has all of them copied.
 *
 * # Safety
 * `sample`, `data` and `len` point to room for one each; `info` is null or does.
 */
axon_ret_t axon_session_subscription_take_sample(struct axon_subscription_t subscription,
                                                 struct axon_sample_t *sample,
                                                 const uint8_t **data,
                                                 size_t *len,
                                                 struct axon_message_info_t *info);

/**
 * Gives a sample that was taken in place back: of a subscription, a server or a client. It may be
 * released after these have ended.
 */
axon_ret_t axon_session_sample_release(struct axon_sample_t sample);

/**
 * Samples of the subscription that were lost: overwritten before they were taken, or lost on their
 * way from another host.
 *
 * # Safety
 * `lost` points to room for a number.
 */
axon_ret_t axon_session_subscription_lost(struct axon_subscription_t subscription, uint64_t *lost);

/**
 * Has `callback` told of new samples from now on, in place of the one before, which has returned and
 * is not called any more when this returns, unless this is called from within it. Null: nobody is
 * told. What is there to be taken, and nobody was told of, it is told at once, in this call; the rest on
 * the session's thread.
 *
 * AXON_RET_ERROR: an event loop of the program's listens already.
 *
 * # Safety
 * `callback` may be called with `user` from any thread until it is replaced or the subscription is
 * destroyed.
 */
axon_ret_t axon_session_subscription_set_callback(struct axon_subscription_t subscription,
                                                  axon_callback_t callback,
                                                  const void *user);

/**
 * What went wrong in the last call of this thread that failed: what, of which topic and node, why,
 * and what to do. Empty where none has. The text stands until the next call that fails in this
 * thread; it is null in a thread that is ending.
 */
const char *axon_session_last_error(void);

/**
 * One event of a publisher: AXON_RET_INVALID_ARGUMENT where `kind` is not one of its. It may be used
 * after the publisher has ended, and then does not happen again.
 *
 * # Safety
 * `event` points to room for a handle.
 */
axon_ret_t axon_session_publisher_event(struct axon_publisher_t publisher,
                                        uint32_t kind,
                                        struct axon_event_t *event);

/**
 * One event of a subscription, as `axon_session_publisher_event`.
 *
 * # Safety
 * As there.
 */
axon_ret_t axon_session_subscription_event(struct axon_subscription_t subscription,
                                           uint32_t kind,
                                           struct axon_event_t *event);

/**
 * Gives an event's handle up. Its callback has returned, and is not called any more, when this returns;
 * those of other handles of the same event are.
 */
axon_ret_t axon_session_event_destroy(struct axon_event_t event);

/**
 * The status. Its changes are counted anew from here, and the event is not ready any more until it
 * happens again.
 *
 * # Safety
 * `status` points to room for one.
 */
axon_ret_t axon_session_event_take(struct axon_event_t event, struct axon_event_status_t *status);

/**
 * Has `callback` told of the event from now on, in place of the one that this handle had before, which
 * has returned and is not called any more when this returns, unless this is called from within it.
 * Null: nobody is told. What happened since the status was last taken, and nobody was told of by this
 * handle, it is told at once, in this call.
 *
 * # Safety
 * `callback` may be called with `user` from any thread until it is replaced or the event is
 * destroyed.
 */
axon_ret_t axon_session_event_set_callback(struct axon_event_t event,
                                           axon_callback_t callback,
                                           const void *user);

/**
 * Calls `visitor` with every node of the graph, in order of namespace and name: as often as nodes of
 * one name are there. What it is given stands until it returns; no lock is held meanwhile.
 *
 * # Safety
 * `visitor` may be called with `user`.
 */
axon_ret_t axon_session_graph_nodes(struct axon_session_t session,
                                    axon_node_visitor_t visitor,
                                    void *user);

/**
 * Calls `visitor` with the names that endpoints of the given kinds (the sum of AXON_KIND_*) have, in
 * order, each with its types: of all endpoints, or, where `node` is not null, of those of the node of
 * this name and namespace.
 *
 * AXON_RET_NO_NODE: there is none.
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
 * Calls `visitor` with every endpoint of a kind (AXON_KIND_*) under a topic's or service's name, or,
 * where `topic` is null, of that kind.
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
 * How many endpoints of a kind (AXON_KIND_*) are under a topic's or service's name. One that is
 * counted is one that gets data.
 *
 * # Safety
 * `topic` is a string; `count` points to room for a number.
 */
axon_ret_t axon_session_graph_count(struct axon_session_t session,
                                    uint32_t kind,
                                    const char *topic,
                                    size_t *count);

/**
 * Has `callback` told of what the library says in this process, in place of the one before, which has
 * returned and is not called any more when this returns; it blocks until then. To set the one that is
 * set already with the same `user` changes nothing, and does not block. Null: nobody is told, as at
 * first. A daemon has a log of its own. A forked child says it again for what it says itself.
 *
 * AXON_RET_ERROR: it is called from within a callback, or a part of the program in Rust has what the
 * library says already (a global `tracing` subscriber).
 *
 * # Safety
 * `callback` may be called with `user` from any thread until it is replaced.
 */
axon_ret_t axon_session_log_set_callback(axon_log_t callback,
                                         const void *user);

/**
 * How severe a line must be at least to be told: AXON_LOG_WARN at first. A severity between those that
 * have a name is as good as any.
 */
axon_ret_t axon_session_log_set_severity(uint32_t severity);

/**
 * A node, which is in the graph until it is destroyed; its endpoints do not end with it. Two nodes
 * may have the same name. It keeps its session open.
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
 * Takes a node out of the graph. It may block for milliseconds, as `axon_session_close` says.
 */
axon_ret_t axon_session_node_destroy(struct axon_node_t node);

/**
 * The guard condition that is triggered after every change of the graph, once what one asks of the
 * graph shows it, and when a service or a client of the session finds or loses its other end. It
 * is a handle of its own, to be destroyed like one that was created, and lasts as long as the
 * session.
 *
 * # Safety
 * `guard` points to room for a handle.
 */
axon_ret_t axon_session_node_graph_guard(struct axon_node_t node, struct axon_guard_t *guard);

/**
 * Whether a publisher with the one profile serves a subscription with the other: AXON_QOS_* at
 * `verdict`. Why not, or on what it hangs, is put into `reason` in words, cut to `reason_size`
 * bytes with the 0 at its end; null and 0 where that is not wanted.
 *
 * # Safety
 * `offered` and `requested` point to a profile each, `verdict` to room for a number, and `reason` to
 * room for `reason_size` bytes.
 */
axon_ret_t axon_session_qos_check(const struct axon_qos_t *offered,
                                  const struct axon_qos_t *requested,
                                  uint32_t *verdict,
                                  char *reason,
                                  size_t reason_size);

/**
 * The name of a policy as ROS 2 spells it, for instance `RELIABILITY`; null where there is none of
 * that number. It stands for ever.
 */
const char *axon_session_policy_name(uint32_t policy);

/**
 * Fills options in with what is usual. `abi` is the program's AXON_SESSION_ABI: AXON_RET_ABI where
 * the library has another, and nothing is written then.
 *
 * # Safety
 * `options` points to room for them, as the program's header declares them.
 */
axon_ret_t axon_session_options_init(struct axon_session_options_t *options, uint32_t abi);

/**
 * Checks the settings as `axon_session_open` does, and opens nothing.
 *
 * AXON_RET_CONFIG: one is wrong; the text names the variable, what was read, and what is accepted.
 *
 * # Safety
 * As for `axon_session_open`.
 */
axon_ret_t axon_session_options_check(const struct axon_session_options_t *options);

/**
 * How other hosts prove who they are to a session with these options: AXON_AUTHENTICATION_*, as the
 * environment and `axon.toml` say it. Opens nothing.
 *
 * AXON_RET_CONFIG: a setting is wrong, as for `axon_session_options_check`.
 *
 * # Safety
 * As for `axon_session_open`; `authentication` points to room for a number.
 */
axon_ret_t axon_session_options_authentication(const struct axon_session_options_t *options,
                                               uint32_t *authentication);

/**
 * Opens a session, and starts a daemon where none runs and `AXON_DAEMON` lets it. A process may have
 * any number of them.
 *
 * Blocks until the daemon has answered: milliseconds, or up to 20 s where one is started.
 *
 * AXON_RET_CONFIG: a setting is wrong, or the daemon that runs has other security settings; the text
 * names the variable. Or the permissions cannot be read, are not valid now, or allow nothing in the
 * session's domain; the text names the file. AXON_RET_ERROR: there is no daemon and none can be
 * started, or it does not answer. AXON_RET_BAD_ALLOC: shared memory is short.
 *
 * # Safety
 * `options` points to options that `axon_session_options_init` filled in, whose pointers are null or
 * point to what they say; `session` points to room for a handle.
 */
axon_ret_t axon_session_open(const struct axon_session_options_t *options,
                             struct axon_session_t *session);

/**
 * Gives a session's handle up. The session ends when the last of its nodes, endpoints and events is
 * destroyed and the last call returns that uses one, which then blocks for milliseconds while its
 * thread ends.
 */
axon_ret_t axon_session_close(struct axon_session_t session);

/**
 * The domain that the session is in.
 *
 * # Safety
 * `domain` points to room for a number.
 */
axon_ret_t axon_session_domain(struct axon_session_t session, uint32_t *domain);

/**
 * Whether the session reaches its daemon: 1, or 0 while there is none, as after it died, until
 * another has taken over. Where `AXON_DAEMON` is `off` there is none to reach: 1. What is attached
 * flows on either way.
 *
 * # Safety
 * `connected` points to room for a number.
 */
axon_ret_t axon_session_is_connected(struct axon_session_t session, uint8_t *connected);

/**
 * A guard condition of a session. It does not keep the session open: it may be triggered and destroyed
 * when that has ended, but nobody can wait for it any more.
 *
 * # Safety
 * `guard` points to room for a handle.
 */
axon_ret_t axon_session_guard_create(struct axon_session_t session,
                                     struct axon_guard_t *guard);

/**
 * Gives a guard condition's handle up. A wait that waits for it goes on without.
 */
axon_ret_t axon_session_guard_destroy(struct axon_guard_t guard);

/**
 * Triggers a guard condition. Async-signal-safe: it takes no lock and no memory, and a signal handler
 * may call it at any time. It leaves errno and the text of the last error alone.
 *
 * AXON_RET_INVALID_HANDLE: it names none, or is being destroyed.
 */
axon_ret_t axon_session_guard_trigger(struct axon_guard_t guard);

/**
 * Blocks until at least one of what is in `set` is ready, for at most `timeout` nanoseconds: 0 not at
 * all, AXON_WAIT_FOREVER (any negative number) without end, also where the set is empty. Then sets
 * all handles in the arrays to 0 that are not ready.
 *
 * AXON_RET_TIMEOUT: none was ready in time; all handles are 0. Every other failure leaves the arrays
 * as they were: AXON_RET_INVALID_HANDLE where one names nothing, AXON_RET_INVALID_ARGUMENT where one is
 * of another session that is closed. What is of another session of this process can be waited for
 * too, and takes a thread more on its way.
 *
 * Any number of threads may wait at once, each with arrays of its own. What is destroyed meanwhile is
 * out of the graph at once; the wait goes on.
 *
 * # Safety
 * `set` points to a set whose arrays hold as many handles as it says, which nobody else uses during
 * the call.
 */
axon_ret_t axon_session_wait(struct axon_session_t session,
                             const struct axon_wait_set_t *set,
                             int64_t timeout);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* AXON_H */
