/* Guard conditions, waits, and events. */
#include "check.h"

#include <pthread.h>
#include <signal.h>
#include <unistd.h>

static axon_guard_t signalled;

static void on_signal(int number) {
    (void)number;
    axon_session_guard_trigger(signalled);
}

void case_waits(void) {
    struct place place = open_place("waits");
    axon_subscription_t listeners[2] = {subscription(place, "/one"), subscription(place, "/two")};
    axon_publisher_t talker = publisher(place, "/two");
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    axon_guard_t stop, graph;
    OK(axon_session_guard_create(place.session, &stop));
    OK(axon_session_node_graph_guard(place.node, &graph));

    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    RETURNS(AXON_RET_TIMEOUT, axon_session_wait(place.session, &set, 0), "ready");
    axon_subscription_t waited[3] = {listeners[0], {0}, listeners[1]};
    axon_guard_t guards[1] = {stop};
    set.subscriptions = waited;
    set.subscription_count = 3;
    set.guards = guards;
    set.guard_count = 1;
    RETURNS(AXON_RET_TIMEOUT, axon_session_wait(place.session, &set, 1000000), "");
    CHECK(waited[0].id == 0 && waited[1].id == 0 && waited[2].id == 0 && guards[0].id == 0);

    OK(axon_session_publisher_publish(talker, (const uint8_t *)"two", 3, AXON_TIME_NOW, NULL));
    waited[0] = listeners[0], waited[2] = listeners[1], guards[0] = stop;
    OK(axon_session_wait(place.session, &set, AXON_WAIT_FOREVER));
    CHECK(waited[0].id == 0 && waited[2].id == listeners[1].id && guards[0].id == 0);

    /* Both, and the guard condition stands for one wait only. */
    OK(axon_session_guard_trigger(stop));
    OK(axon_session_guard_trigger(stop));
    guards[0] = stop;
    OK(axon_session_wait(place.session, &set, 0));
    CHECK(waited[2].id == listeners[1].id && guards[0].id == stop.id);
    struct message message;
    CHECK(take(listeners[1], &message));
    guards[0] = stop, waited[2] = listeners[1];
    RETURNS(AXON_RET_TIMEOUT, axon_session_wait(place.session, &set, 0), "");

    /* A signal handler's. */
    signalled = stop;
    struct sigaction action;
    memset(&action, 0, sizeof action);
    action.sa_handler = on_signal;
    CHECK(sigaction(SIGUSR1, &action, NULL) == 0);
    CHECK(raise(SIGUSR1) == 0);
    guards[0] = stop;
    OK(axon_session_wait(place.session, &set, PATIENCE));
    CHECK(guards[0].id == stop.id);

    /* The graph's, which may stand already. */
    guards[0] = graph;
    (void)axon_session_wait(place.session, &set, 0);
    axon_publisher_t newcomer = publisher(place, "/newcomer");
    guards[0] = graph;
    OK(axon_session_wait(place.session, &set, PATIENCE));
    CHECK(guards[0].id == graph.id);

    /* Of another session. */
    struct place other = open_place("other");
    axon_guard_t theirs;
    OK(axon_session_guard_create(other.session, &theirs));
    OK(axon_session_guard_trigger(theirs));
    guards[0] = theirs, waited[0] = listeners[0];
    OK(axon_session_wait(place.session, &set, AXON_WAIT_FOREVER));
    CHECK(guards[0].id == theirs.id && waited[0].id == 0);

    /* Gone: nothing is waited for, and nothing set to 0. */
    guards[0] = theirs, waited[0] = listeners[0];
    OK(axon_session_guard_destroy(theirs));
    NO_HANDLE(axon_session_wait(place.session, &set, AXON_WAIT_FOREVER));
    CHECK(guards[0].id == theirs.id && waited[0].id == listeners[0].id);

    /* What is left of a session that has ended. */
    OK(axon_session_guard_create(other.session, &theirs));
    close_place(other);
    guards[0] = theirs, waited[0] = listeners[0];
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_wait(place.session, &set, AXON_WAIT_FOREVER),
            "session");
    CHECK(guards[0].id == theirs.id && waited[0].id == listeners[0].id);
    OK(axon_session_guard_trigger(theirs));
    OK(axon_session_guard_destroy(theirs));

    OK(axon_session_publisher_destroy(newcomer));
    OK(axon_session_guard_destroy(graph));
    OK(axon_session_guard_destroy(stop));
    NO_HANDLE(axon_session_guard_destroy(stop));
    CHECK(axon_session_guard_trigger(stop) == AXON_RET_INVALID_HANDLE);
    OK(axon_session_publisher_destroy(talker));
    OK(axon_session_subscription_destroy(listeners[0]));
    OK(axon_session_subscription_destroy(listeners[1]));
    close_place(place);
}

static void add(const void *user, size_t count) {
    *(size_t *)user += count;
}

/* On the session's thread. */
static void hear(const void *user, size_t count) {
    __atomic_fetch_add((size_t *)user, count, __ATOMIC_SEQ_CST);
}

void case_events(void) {
    struct place place = open_place("events");
    axon_endpoint_options_t weak = endpoint("/events");
    weak.qos.reliability = AXON_RELIABILITY_BEST_EFFORT;
    axon_publisher_t talker;
    OK(axon_session_publisher_create(place.node, &weak, &talker));
    axon_subscription_t strict = subscription(place, "/events");
    axon_subscription_t listener;
    OK(axon_session_subscription_create(place.node, &weak, &listener));
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));

    axon_event_t matched, refused, all[11];
    OK(axon_session_publisher_event(talker, AXON_EVENT_PUBLICATION_MATCHED, &matched));
    OK(axon_session_subscription_event(strict, AXON_EVENT_REQUESTED_QOS_INCOMPATIBLE, &refused));
    for (uint32_t kind = 0; kind < 11; kind++) {
        int of_publisher = kind >= AXON_EVENT_LIVELINESS_LOST;
        RETURNS(of_publisher ? AXON_RET_OK : AXON_RET_INVALID_ARGUMENT,
                axon_session_publisher_event(talker, kind, &all[kind]), NULL);
        RETURNS(of_publisher ? AXON_RET_INVALID_ARGUMENT : AXON_RET_OK,
                axon_session_subscription_event(listener, kind, &all[kind]), NULL);
    }
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_publisher_event(talker, 11, &all[0]), "event 11");

    axon_event_t waited[2] = {matched, refused};
    axon_wait_set_t set;
    memset(&set, 0, sizeof set);
    set.events = waited;
    set.event_count = 2;
    OK(axon_session_wait(place.session, &set, PATIENCE));
    CHECK(waited[0].id == matched.id);

    axon_event_status_t status;
    OK(axon_session_event_take(matched, &status));
    CHECK(status.kind == AXON_EVENT_PUBLICATION_MATCHED);
    CHECK(status.total == 1 && status.total_change == 1);
    CHECK(status.current == 1 && status.current_change == 1);
    waited[0].id = 0, waited[1] = refused;
    OK(axon_session_wait(place.session, &set, PATIENCE));
    CHECK(waited[1].id == refused.id);
    OK(axon_session_event_take(refused, &status));
    CHECK(status.total == 1 && status.last_policy == AXON_POLICY_RELIABILITY);
    CHECK(strcmp(axon_session_policy_name(status.last_policy), "RELIABILITY") == 0);
    CHECK(axon_session_policy_name(AXON_POLICY_NONE) == NULL);

    /* A callback is told of what happened before; none runs once it is unset. */
    OK(axon_session_subscription_destroy(listener));
    waited[0] = matched, waited[1].id = 0;
    OK(axon_session_wait(place.session, &set, PATIENCE));
    size_t told = 0, samples = 0;
    OK(axon_session_event_set_callback(matched, add, &told));
    CHECK(told == 1);
    OK(axon_session_event_set_callback(matched, NULL, NULL));
    OK(axon_session_event_take(matched, &status));
    CHECK(status.total == 1 && status.total_change == 0);
    CHECK(status.current == 0 && status.current_change == -1);

    OK(axon_session_subscription_create(place.node, &weak, &listener));
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    for (int i = 0; i < 3; i++) {
        OK(axon_session_publisher_publish(talker, (const uint8_t *)"x", 1, AXON_TIME_NOW, NULL));
    }
    OK(axon_session_subscription_set_callback(listener, add, &samples));
    OK(axon_session_subscription_set_callback(listener, NULL, NULL));
    CHECK(samples == 3);
    /* As often as one likes, also while the session's thread still listens for the last one. */
    static size_t heard;
    for (int i = 0; i < 50; i++) {
        struct message message;
        while (take(listener, &message)) {
        }
        OK(axon_session_subscription_set_callback(listener, hear, &heard));
        size_t before = __atomic_load_n(&heard, __ATOMIC_SEQ_CST);
        OK(axon_session_publisher_publish(talker, (const uint8_t *)"x", 1, AXON_TIME_NOW, NULL));
        for (int wait = 0; __atomic_load_n(&heard, __ATOMIC_SEQ_CST) == before; wait++) {
            CHECK(wait < 600000);
            usleep(100);
        }
        OK(axon_session_subscription_set_callback(listener, NULL, NULL));
    }
    OK(axon_session_event_set_callback(matched, add, &told));
    OK(axon_session_event_destroy(matched));
    NO_HANDLE(axon_session_event_take(matched, &status));
    OK(axon_session_event_destroy(refused));
    for (int kind = 0; kind < 11; kind++) {
        /* Of endpoints that end first. */
        if (kind == 5) {
            OK(axon_session_subscription_destroy(listener));
            OK(axon_session_publisher_destroy(talker));
        }
        if (kind < 6) {
            OK(axon_session_event_take(all[kind], &status));
        }
        OK(axon_session_event_destroy(all[kind]));
    }
    OK(axon_session_subscription_destroy(strict));
    close_place(place);
}
