/* What no program should do, and none may die of. */
#include "check.h"

#include <pthread.h>
#include <sys/wait.h>
#include <unistd.h>

void case_settings(void) {
    CHECK(axon_session_abi() == AXON_SESSION_ABI);
    CHECK(axon_session_last_error() != NULL);
    axon_session_options_t options;
    memset(&options, 7, sizeof options);
    axon_session_options_t before = options;
    RETURNS(AXON_RET_ABI, axon_session_options_init(&options, AXON_SESSION_ABI + 1), "axon.h");
    CHECK(memcmp(&before, &options, sizeof options) == 0);
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_options_init(NULL, AXON_SESSION_ABI), "null");
    axon_session_t session = {7};
    RETURNS(AXON_RET_ABI, axon_session_open(&options, &session), "version");
    CHECK(session.id == 7);
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_open(NULL, &session), "options");

    OK(axon_session_options_init(&options, AXON_SESSION_ABI));
    OK(axon_session_options_check(&options));
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_open(&options, NULL), "null");
    options.domain = 233;
    RETURNS(AXON_RET_CONFIG, axon_session_options_check(&options), "ROS_DOMAIN_ID");
    options.domain = 17;
    options.discovery = 99;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_options_check(&options), "99");
    const char *peers[] = {"10.0.0.1", "no such host!"};
    options.discovery = AXON_DISCOVERY_SUBNET;
    options.static_peers = peers;
    options.static_peer_count = 2;
    RETURNS(AXON_RET_CONFIG, axon_session_open(&options, &session), "ROS_STATIC_PEERS");
    options.static_peer_count = 1;
    options.discovery = AXON_DISCOVERY_LOCALHOST;
    options.name = "\xff";
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_open(&options, &session), "UTF-8");
    options.name = NULL;
    /* A wrong security setting is named before anything is made. */
    CHECK(setenv("AXON_SECURITY_MODE", "qkdd", 1) == 0);
    RETURNS(AXON_RET_CONFIG, axon_session_open(&options, &session), "AXON_SECURITY_MODE");
    CHECK(unsetenv("AXON_SECURITY_MODE") == 0);
    CHECK(session.id == 7);
    OK(axon_session_open(&options, &session));
    uint32_t domain = 0;
    OK(axon_session_domain(session, &domain));
    CHECK(domain == 17);
    uint8_t connected = 0;
    OK(axon_session_is_connected(session, &connected));
    CHECK(connected == 1);
    OK(axon_session_close(session));
    NO_HANDLE(axon_session_close(session));
    NO_HANDLE(axon_session_domain(session, &domain));

    axon_qos_t offered, requested;
    memset(&offered, 0, sizeof offered);
    memset(&requested, 0, sizeof requested);
    uint32_t verdict = 7;
    char reason[200] = "?";
    OK(axon_session_qos_check(&offered, &requested, &verdict, reason, sizeof reason));
    offered.reliability = AXON_RELIABILITY_BEST_EFFORT;
    requested.reliability = AXON_RELIABILITY_RELIABLE;
    OK(axon_session_qos_check(&offered, &requested, &verdict, reason, sizeof reason));
    CHECK(verdict == AXON_QOS_INCOMPATIBLE && strstr(reason, "RELIABILITY: ") == reason);
    OK(axon_session_qos_check(&offered, &requested, &verdict, reason, 5));
    CHECK(strcmp(reason, "RELI") == 0);
    OK(axon_session_qos_check(&offered, &requested, &verdict, NULL, 0));
    offered.reliability = AXON_CHOICE_BEST_AVAILABLE;
    OK(axon_session_qos_check(&offered, &requested, &verdict, reason, sizeof reason));
    CHECK(verdict == AXON_QOS_UNKNOWN);
    offered.reliability = AXON_RELIABILITY_RELIABLE;
    offered.durability = AXON_DURABILITY_VOLATILE;
    offered.liveliness = AXON_LIVELINESS_AUTOMATIC;
    offered.deadline = offered.lease = AXON_DURATION_INFINITE;
    OK(axon_session_qos_check(&offered, &offered, &verdict, reason, sizeof reason));
    CHECK(verdict == AXON_QOS_COMPATIBLE && reason[0] == 0);
    offered.liveliness = 2;
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_qos_check(&offered, &requested, &verdict, NULL, 0), "liveliness 2");
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_qos_check(NULL, &requested, &verdict, NULL, 0), "null");
}

static void no_node(void *user, const char *name, const char *namespace_, const char *enclave) {
    (void)user, (void)name, (void)namespace_, (void)enclave;
    CHECK(!"of a session that is not there");
}

static void no_name(void *user, const char *name, const char *const *types, size_t type_count) {
    (void)type_count, (void)types;
    no_node(user, name, NULL, NULL);
}

static void no_endpoint(void *user, const axon_endpoint_t *endpoint) {
    (void)endpoint;
    no_node(user, NULL, NULL, NULL);
}

/* Every function that takes a handle, with this one. */
static void use(uint64_t id) {
    axon_session_t session = {id};
    axon_node_t node = {id};
    axon_publisher_t publisher = {id};
    axon_subscription_t subscription = {id};
    axon_server_t server = {id};
    axon_client_t client = {id};
    axon_guard_t guard = {id};
    axon_event_t event = {id};
    axon_sample_t sample = {id};
    axon_loan_t loan = {id};
    axon_endpoint_options_t options = endpoint("/misuse");
    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    struct message message;
    uint8_t byte, *data;
    uint32_t number;
    size_t size;
    uint64_t count;
    const uint8_t *bytes;
    axon_event_status_t status;
    axon_gid_t gid;
    memset(&gid, 0, sizeof gid);
    NO_HANDLE(axon_session_close(session));
    NO_HANDLE(axon_session_domain(session, &number));
    NO_HANDLE(axon_session_is_connected(session, &byte));
    NO_HANDLE(axon_session_node_create(session, "n", "/", "/", &node));
    NO_HANDLE(axon_session_node_destroy(node));
    NO_HANDLE(axon_session_node_graph_guard(node, &guard));
    NO_HANDLE(axon_session_publisher_create(node, &options, &publisher));
    NO_HANDLE(axon_session_publisher_destroy(publisher));
    NO_HANDLE(axon_session_publisher_describe(publisher, NULL, NULL));
    NO_HANDLE(axon_session_publisher_publish(publisher, NULL, 0, AXON_TIME_NOW, NULL));
    NO_HANDLE(axon_session_publisher_skip_unread(publisher, &count));
    NO_HANDLE(axon_session_publisher_matched(publisher, &size));
    NO_HANDLE(axon_session_publisher_wait_matched(publisher, 1, AXON_WAIT_FOREVER));
    NO_HANDLE(axon_session_publisher_wait_acknowledged(publisher, AXON_WAIT_FOREVER));
    NO_HANDLE(axon_session_publisher_assert_liveliness(publisher));
    NO_HANDLE(axon_session_publisher_loan(publisher, 0, 1, &loan, &data));
    NO_HANDLE(axon_session_publisher_event(publisher, AXON_EVENT_LIVELINESS_LOST, &event));
    NO_HANDLE(axon_session_loan_publish(loan, 0, AXON_TIME_NOW, NULL));
    NO_HANDLE(axon_session_loan_abandon(loan));
    NO_HANDLE(axon_session_subscription_create(node, &options, &subscription));
    NO_HANDLE(axon_session_subscription_destroy(subscription));
    NO_HANDLE(axon_session_subscription_describe(subscription, NULL, NULL));
    NO_HANDLE(axon_session_subscription_matched(subscription, &size));
    NO_HANDLE(axon_session_subscription_wait_matched(subscription, 1, AXON_WAIT_FOREVER));
    NO_HANDLE(axon_session_subscription_take(subscription, room, &message, NULL, &byte));
    NO_HANDLE(axon_session_subscription_take_sample(subscription, &sample, &bytes, &size, NULL));
    NO_HANDLE(axon_session_subscription_lost(subscription, &count));
    NO_HANDLE(axon_session_subscription_set_callback(subscription, NULL, NULL));
    NO_HANDLE(axon_session_subscription_event(subscription, AXON_EVENT_MESSAGE_LOST, &event));
    NO_HANDLE(axon_session_server_create(node, &options, &server));
    NO_HANDLE(axon_session_server_destroy(server));
    NO_HANDLE(axon_session_server_describe(server, NULL, NULL));
    NO_HANDLE(axon_session_server_matched(server, &size));
    NO_HANDLE(axon_session_server_take(server, room, &message, NULL, &byte));
    NO_HANDLE(axon_session_server_take_sample(server, &sample, &bytes, &size, NULL));
    NO_HANDLE(axon_session_server_respond(server, &gid, 1, NULL, 0));
    NO_HANDLE(axon_session_server_respond_at(server, &gid, 1, 77, NULL, 0));
    NO_HANDLE(axon_session_server_set_callback(server, NULL, NULL));
    NO_HANDLE(axon_session_client_create(node, &options, &client));
    NO_HANDLE(axon_session_client_destroy(client));
    NO_HANDLE(axon_session_client_describe(client, NULL, NULL));
    NO_HANDLE(axon_session_client_matched(client, &size));
    NO_HANDLE(axon_session_client_wait_available(client, AXON_WAIT_FOREVER));
    NO_HANDLE(axon_session_client_request(client, NULL, 0, NULL));
    NO_HANDLE(axon_session_client_take(client, room, &message, NULL, &byte));
    NO_HANDLE(axon_session_client_take_sample(client, &sample, &bytes, &size, NULL));
    NO_HANDLE(axon_session_client_set_callback(client, NULL, NULL));
    NO_HANDLE(axon_session_graph_nodes(session, no_node, NULL));
    NO_HANDLE(axon_session_graph_names(session, AXON_KIND_PUBLISHER, NULL, NULL, no_name, NULL));
    NO_HANDLE(axon_session_graph_endpoints(session, AXON_KIND_PUBLISHER, "/t", no_endpoint, NULL));
    NO_HANDLE(axon_session_graph_count(session, AXON_KIND_PUBLISHER, "/t", &size));
    NO_HANDLE(axon_session_sample_release(sample));
    NO_HANDLE(axon_session_event_take(event, &status));
    NO_HANDLE(axon_session_event_set_callback(event, NULL, NULL));
    NO_HANDLE(axon_session_event_destroy(event));
    NO_HANDLE(axon_session_guard_create(session, &guard));
    NO_HANDLE(axon_session_guard_destroy(guard));
    CHECK(axon_session_guard_trigger(guard) == AXON_RET_INVALID_HANDLE);
    NO_HANDLE(axon_session_wait(session, &set, AXON_WAIT_FOREVER));
}

void case_misuse(void) {
    use(0);
    use(1);
    use(STALE);
    use(UINT64_MAX);
    struct place place = open_place("misuse");
    axon_publisher_t talker = publisher(place, "/misuse");
    axon_subscription_t listener = subscription(place, "/misuse");
    use(0);
    /* One of another kind. */
    axon_subscription_t wrong = {talker.id};
    size_t size = 7;
    RETURNS(AXON_RET_INVALID_HANDLE, axon_session_subscription_matched(wrong, &size), "publisher");
    CHECK(size == 7);

    /* Null where there must be something. */
    axon_endpoint_options_t options = endpoint("/misuse");
    axon_publisher_t made = {7};
    axon_subscription_t heard = {7};
    axon_node_t node = {7};
    const uint8_t *bytes = NULL;
    uint8_t byte = 7, *data = NULL;
    axon_loan_t loan;
    axon_sample_t sample;
    struct message message;
    axon_event_t event;
#define REFUSED(call) RETURNS(AXON_RET_INVALID_ARGUMENT, call, "null")
    REFUSED(axon_session_domain(place.session, NULL));
    REFUSED(axon_session_is_connected(place.session, NULL));
    REFUSED(axon_session_node_create(place.session, NULL, "/", "/", &node));
    REFUSED(axon_session_node_create(place.session, "n", NULL, "/", &node));
    REFUSED(axon_session_node_create(place.session, "n", "/", NULL, &node));
    REFUSED(axon_session_node_create(place.session, "n", "/", "/", NULL));
    REFUSED(axon_session_node_graph_guard(place.node, NULL));
    REFUSED(axon_session_publisher_create(place.node, NULL, &made));
    REFUSED(axon_session_publisher_create(place.node, &options, NULL));
    REFUSED(axon_session_subscription_create(place.node, NULL, &heard));
    REFUSED(axon_session_subscription_create(place.node, &options, NULL));
    REFUSED(axon_session_publisher_publish(talker, NULL, 1, AXON_TIME_NOW, NULL));
    REFUSED(axon_session_publisher_skip_unread(talker, NULL));
    REFUSED(axon_session_publisher_matched(talker, NULL));
    REFUSED(axon_session_publisher_loan(talker, 0, 1, NULL, &data));
    REFUSED(axon_session_publisher_loan(talker, 0, 1, &loan, NULL));
    REFUSED(axon_session_publisher_event(talker, AXON_EVENT_LIVELINESS_LOST, NULL));
    REFUSED(axon_session_subscription_event(listener, AXON_EVENT_MESSAGE_LOST, NULL));
    REFUSED(axon_session_subscription_take(listener, NULL, &message, NULL, &byte));
    REFUSED(axon_session_subscription_take(listener, room, &message, NULL, NULL));
    REFUSED(axon_session_subscription_take_sample(listener, NULL, &bytes, &size, NULL));
    REFUSED(axon_session_subscription_take_sample(listener, &sample, NULL, &size, NULL));
    REFUSED(axon_session_subscription_take_sample(listener, &sample, &bytes, NULL, NULL));
    REFUSED(axon_session_subscription_lost(listener, NULL));
    REFUSED(axon_session_subscription_matched(listener, NULL));
    REFUSED(axon_session_guard_create(place.session, NULL));
    REFUSED(axon_session_wait(place.session, NULL, 0));
    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    set.clients = NULL;
    set.client_count = 1;
    REFUSED(axon_session_wait(place.session, &set, 0));
    OK(axon_session_subscription_event(listener, AXON_EVENT_MESSAGE_LOST, &event));
    REFUSED(axon_session_event_take(event, NULL));
    OK(axon_session_event_destroy(event));
    options.topic = NULL;
    REFUSED(axon_session_publisher_create(place.node, &options, &made));
    options.topic = "/misuse";
    options.type_hash_size = 3;
    REFUSED(axon_session_publisher_create(place.node, &options, &made));

    /* Not aligned: nothing is done, and nothing published. */
    uint64_t sequence = 0;
    union {
        uint64_t aligned;
        unsigned char bytes[16];
    } raw;
    REFUSED(axon_session_publisher_publish(talker, &byte, 1, AXON_TIME_NOW,
                                           (uint64_t *)(void *)(raw.bytes + 1)));
    OK(axon_session_publisher_publish(talker, &byte, 1, AXON_TIME_NOW, &sequence));
    CHECK(sequence == 1);

    /* More than there can be, and what is not there. */
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_publisher_publish(talker, &byte, SIZE_MAX, AXON_TIME_NOW, NULL), "more than");
    set.guards = (axon_guard_t *)(uintptr_t)16;
    set.guard_count = SIZE_MAX / 4;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_wait(place.session, &set, 0), "more than");
    options = endpoint("");
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_publisher_create(place.node, &options, &made), "");
    options = endpoint("/misuse");
    options.type_name = "\xc3(";
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_publisher_create(place.node, &options, &made),
            "UTF-8");
    options = endpoint("/misuse");
    options.qos.history = 9;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_subscription_create(place.node, &options, &heard),
            "history 9");
    uint8_t hash[AXON_TYPE_HASH_SIZE + 1] = {0};
    options = endpoint("/misuse");
    options.type_hash = hash;
    options.type_hash_size = sizeof hash;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_publisher_create(place.node, &options, &made),
            "/misuse");
    options.type_hash_size = SIZE_MAX / 2;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_publisher_create(place.node, &options, &made),
            "/misuse");
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_node_create(place.session, "", "/", "/", &node), "");
    CHECK(made.id == 7 && heard.id == 7 && node.id == 7);

    /* In an order that nobody would choose; twice. */
    OK(axon_session_close(place.session));
    OK(axon_session_node_destroy(place.node));
    NO_HANDLE(axon_session_node_destroy(place.node));
    OK(axon_session_publisher_publish(talker, &byte, 1, AXON_TIME_NOW, NULL));
    OK(axon_session_publisher_destroy(talker));
    NO_HANDLE(axon_session_publisher_destroy(talker));
    OK(axon_session_subscription_destroy(listener));
    NO_HANDLE(axon_session_subscription_destroy(listener));
}

/* What the threads race for. */
static struct {
    struct place place;
    axon_publisher_t talker;
    axon_subscription_t listener;
    axon_server_t server;
    axon_client_t client;
    axon_event_t event;
    axon_guard_t guard;
    pthread_barrier_t start;
} shared;

static int worked_or_gone(axon_ret_t ret) {
    CHECK(ret == AXON_RET_OK || ret == AXON_RET_INVALID_HANDLE || ret == AXON_RET_TIMEOUT);
    return ret != AXON_RET_INVALID_HANDLE;
}

static void *use_shared(void *argument) {
    (void)argument;
    pthread_barrier_wait(&shared.start);
    int going = 1;
    while (going) {
        struct message message;
        uint8_t taken, byte = 1;
        axon_sample_t sample;
        const uint8_t *data;
        uint8_t *lent;
        size_t len;
        axon_loan_t loan;
        axon_wait_set_t set;
        memset(&set, 0, sizeof set);
        axon_subscription_t waited = shared.listener;
        axon_guard_t guard = shared.guard;
        set.subscriptions = &waited;
        set.subscription_count = 1;
        set.guards = &guard;
        set.guard_count = 1;
        going = worked_or_gone(
            axon_session_publisher_publish(shared.talker, &byte, 1, AXON_TIME_NOW, NULL));
        if (worked_or_gone(axon_session_publisher_loan(shared.talker, 0, 5000, &loan, &lent))) {
            lent[0] = 1;
            worked_or_gone(axon_session_loan_publish(loan, 4999, AXON_TIME_NOW, NULL));
        }
        worked_or_gone(axon_session_subscription_take(shared.listener, room, &message, NULL, &taken));
        axon_ret_t ret =
            axon_session_subscription_take_sample(shared.listener, &sample, &data, &len, NULL);
        if (worked_or_gone(ret) && sample.id != 0) {
            OK(axon_session_sample_release(sample));
        }
        worked_or_gone(axon_session_client_request(shared.client, &byte, 1, NULL));
        axon_message_info_t *asked = &message.info;
        ret = axon_session_server_take(shared.server, room, &message, asked, &taken);
        if (worked_or_gone(ret) && taken) {
            worked_or_gone(axon_session_server_respond(shared.server, &asked->sender,
                                                       asked->publication_sequence, &byte, 1));
        }
        worked_or_gone(axon_session_client_take(shared.client, room, &message, NULL, &taken));
        axon_event_status_t status;
        worked_or_gone(axon_session_event_take(shared.event, &status));
        (void)axon_session_guard_trigger(shared.guard);
        worked_or_gone(axon_session_wait(shared.place.session, &set, 100000));
    }
    return NULL;
}

static void *wait_for_shared(void *argument) {
    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    axon_subscription_t waited = shared.listener;
    axon_guard_t guard = shared.guard;
    set.subscriptions = &waited;
    set.subscription_count = 1;
    set.guards = &guard;
    set.guard_count = 1;
    pthread_barrier_wait(&shared.start);
    /* What would end it may be another's who waits, or gone. */
    worked_or_gone(axon_session_wait(shared.place.session, &set, SECOND / 20));
    return argument;
}

void case_threads(void) {
    for (int round = 0; round < 20; round++) {
        shared.place = open_place("threads");
        shared.talker = publisher(shared.place, "/threads");
        shared.listener = subscription(shared.place, "/threads");
        axon_endpoint_options_t options = endpoint("/threads/calls");
        OK(axon_session_server_create(shared.place.node, &options, &shared.server));
        OK(axon_session_client_create(shared.place.node, &options, &shared.client));
        OK(axon_session_publisher_event(shared.talker, AXON_EVENT_PUBLICATION_MATCHED, &shared.event));
        OK(axon_session_guard_create(shared.place.session, &shared.guard));
        CHECK(pthread_barrier_init(&shared.start, NULL, 4) == 0);
        pthread_t users[3];
        CHECK(pthread_create(&users[0], NULL, use_shared, NULL) == 0);
        CHECK(pthread_create(&users[1], NULL, use_shared, NULL) == 0);
        CHECK(pthread_create(&users[2], NULL, wait_for_shared, NULL) == 0);
        pthread_barrier_wait(&shared.start);
        usleep((useconds_t)round * 100);
        (void)axon_session_guard_trigger(shared.guard);
        OK(axon_session_subscription_destroy(shared.listener));
        OK(axon_session_server_destroy(shared.server));
        OK(axon_session_event_destroy(shared.event));
        OK(axon_session_publisher_destroy(shared.talker));
        OK(axon_session_client_destroy(shared.client));
        OK(axon_session_guard_destroy(shared.guard));
        close_place(shared.place);
        for (int i = 0; i < 3; i++) {
            CHECK(pthread_join(users[i], NULL) == 0);
        }
        CHECK(pthread_barrier_destroy(&shared.start) == 0);
    }
}

/* Fails with this domain, and sees its own text once the other thread has failed, too. */
static void *fail_with(void *domain) {
    axon_session_options_t options;
    OK(axon_session_options_init(&options, AXON_SESSION_ABI));
    options.domain = *(const uint32_t *)domain;
    char own[8];
    snprintf(own, sizeof own, "%u", (unsigned)options.domain);
    for (int round = 0; round < 100; round++) {
        pthread_barrier_wait(&shared.start);
        RETURNS(AXON_RET_CONFIG, axon_session_options_check(&options), own);
        const char *text = axon_session_last_error();
        pthread_barrier_wait(&shared.start);
        CHECK(text == axon_session_last_error() && strstr(text, own));
    }
    return NULL;
}

void case_texts(void) {
    uint32_t domains[2] = {901, 902};
    CHECK(pthread_barrier_init(&shared.start, NULL, 2) == 0);
    pthread_t other;
    CHECK(pthread_create(&other, NULL, fail_with, &domains[0]) == 0);
    fail_with(&domains[1]);
    CHECK(pthread_join(other, NULL) == 0);
    CHECK(pthread_barrier_destroy(&shared.start) == 0);
}

void case_fork(void) {
    if (!FORKS) {
        return;
    }
    struct place place = open_place("parent");
    axon_publisher_t talker = publisher(place, "/fork");
    axon_subscription_t listener = subscription(place, "/fork");
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    axon_loan_t loan;
    uint8_t *lent;
    OK(axon_session_publisher_loan(talker, 0, 10, &loan, &lent));
    axon_guard_t guard;
    OK(axon_session_guard_create(place.session, &guard));
    fflush(NULL);
    pid_t child = fork();
    CHECK(child >= 0);
    if (child == 0) {
        uint8_t byte = 1, taken = 7;
        struct message message;
        CHECK(axon_session_guard_trigger(guard) == AXON_RET_FORKED);
#define FORKED(call) RETURNS(AXON_RET_FORKED, call, "fork")
        FORKED(axon_session_publisher_publish(talker, &byte, 1, AXON_TIME_NOW, NULL));
        FORKED(axon_session_subscription_take(listener, room, &message, NULL, &taken));
        FORKED(axon_session_loan_publish(loan, 10, AXON_TIME_NOW, NULL));
        FORKED(axon_session_loan_abandon(loan));
        FORKED(axon_session_publisher_destroy(talker));
        FORKED(axon_session_guard_destroy(guard));
        FORKED(axon_session_close(place.session));
        /* It can open one of its own. */
        struct place own = open_place("child");
        axon_publisher_t said = publisher(own, "/fork");
        OK(axon_session_publisher_publish(said, &byte, 1, AXON_TIME_NOW, NULL));
        CHECK(said.id != talker.id);
        FORKED(axon_session_publisher_publish(talker, &byte, 1, AXON_TIME_NOW, NULL));
        OK(axon_session_publisher_destroy(said));
        close_place(own);
        end_child();
    }
    child_ends(child);
    /* The parent goes on. */
    struct message message;
    OK(axon_session_publisher_publish(talker, (const uint8_t *)"on", 2, AXON_TIME_NOW, NULL));
    await(place, listener);
    CHECK(take(listener, &message) && message.len == 2);
    OK(axon_session_loan_abandon(loan));
    OK(axon_session_guard_destroy(guard));
    OK(axon_session_subscription_destroy(listener));
    OK(axon_session_publisher_destroy(talker));
    close_place(place);
}
