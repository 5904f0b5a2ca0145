/* Callbacks: set and destroyed by several threads, and calling the interface themselves. */
#include "check.h"

#include <pthread.h>
#include <sched.h>
#include <unistd.h>

/* What is given to a callback, and freed once nobody may call it with it. */
struct user {
    uint64_t alive;
    axon_subscription_t listener;
    axon_event_t event;
    struct place place;
    size_t told;
    size_t done;
};

#define ALIVE UINT64_C(0xa11fea11fea11fe5)

static struct user *user_of(const void *pointer) {
    struct user *user = (struct user *)(uintptr_t)pointer;
    CHECK(__atomic_load_n(&user->alive, __ATOMIC_SEQ_CST) == ALIVE);
    return user;
}

static struct user *new_user(void) {
    struct user *user = calloc(1, sizeof *user);
    CHECK(user != NULL);
    user->alive = ALIVE;
    return user;
}

static void free_user(struct user *user) {
    /* Also where nobody looks for what is used once it is freed. */
    __atomic_store_n(&user->alive, 0, __ATOMIC_SEQ_CST);
    free(user);
}

static void until(const size_t *number) {
    for (int wait = 0; __atomic_load_n(number, __ATOMIC_SEQ_CST) == 0; wait++) {
        CHECK(wait < 600000);
        usleep(100);
    }
}

static void hear(const void *pointer, size_t count) {
    struct user *user = user_of(pointer);
    CHECK(count > 0);
    sched_yield();
    __atomic_fetch_add(&user->told, count, __ATOMIC_SEQ_CST);
    (void)user_of(pointer);
}

static struct {
    axon_publisher_t talker;
    axon_subscription_t listener;
    axon_event_t event;
    struct user *user;
    pthread_barrier_t start;
} race;

static int set_or_gone(axon_ret_t ret) {
    CHECK(ret == AXON_RET_OK || ret == AXON_RET_INVALID_HANDLE);
    return ret == AXON_RET_OK;
}

static void *set_callbacks(void *argument) {
    pthread_barrier_wait(&race.start);
    int endpoint = 1, event = 1;
    for (int round = 0; endpoint || event; round++) {
        axon_callback_t callback = round % 3 == 2 ? NULL : hear;
        if (endpoint) {
            endpoint = set_or_gone(
                axon_session_subscription_set_callback(race.listener, callback, race.user));
        }
        if (event) {
            event = set_or_gone(axon_session_event_set_callback(race.event, callback, race.user));
        }
    }
    return argument;
}

static void *publish_and_match(void *argument) {
    struct place *place = argument;
    pthread_barrier_wait(&race.start);
    for (int i = 0; i < 20; i++) {
        OK(axon_session_publisher_publish(race.talker, (const uint8_t *)"x", 1, AXON_TIME_NOW, NULL));
        OK(axon_session_subscription_destroy(subscription(*place, "/callbacks")));
    }
    return NULL;
}

/* Whoever destroys may free what the callback is given, whatever others set meanwhile. */
static void race_for_the_end(void) {
    struct place place = open_place("callbacks");
    for (int round = 0; round < 60; round++) {
        race.talker = publisher(place, "/callbacks");
        race.listener = subscription(place, "/callbacks");
        OK(axon_session_publisher_event(race.talker, AXON_EVENT_PUBLICATION_MATCHED, &race.event));
        race.user = new_user();
        CHECK(pthread_barrier_init(&race.start, NULL, 4) == 0);
        pthread_t threads[3];
        CHECK(pthread_create(&threads[0], NULL, set_callbacks, NULL) == 0);
        CHECK(pthread_create(&threads[1], NULL, set_callbacks, NULL) == 0);
        CHECK(pthread_create(&threads[2], NULL, publish_and_match, &place) == 0);
        pthread_barrier_wait(&race.start);
        usleep((useconds_t)round * 20);
        OK(axon_session_subscription_destroy(race.listener));
        OK(axon_session_event_destroy(race.event));
        free_user(race.user);
        for (int i = 0; i < 3; i++) {
            CHECK(pthread_join(threads[i], NULL) == 0);
        }
        CHECK(pthread_barrier_destroy(&race.start) == 0);
        OK(axon_session_publisher_destroy(race.talker));
    }
    close_place(place);
}

static void unset_own(const void *pointer, size_t count) {
    struct user *user = user_of(pointer);
    user->told += count;
    OK(axon_session_subscription_set_callback(user->listener, NULL, NULL));
    __atomic_store_n(&user->done, 1, __ATOMIC_SEQ_CST);
}

static void end_own(const void *pointer, size_t count) {
    struct user *user = user_of(pointer);
    user->told += count;
    if (user->event.id != 0) {
        OK(axon_session_event_destroy(user->event));
        NO_HANDLE(axon_session_event_set_callback(user->event, hear, user));
    }
    if (user->listener.id != 0) {
        struct message message;
        CHECK(take(user->listener, &message));
        OK(axon_session_subscription_destroy(user->listener));
        NO_HANDLE(axon_session_subscription_set_callback(user->listener, hear, user));
    }
    /* The rest of the interface, and the session itself. */
    axon_publisher_t talker = publisher(user->place, "/within");
    axon_subscription_t listener = subscription(user->place, "/within");
    OK(axon_session_publisher_publish(talker, (const uint8_t *)"x", 1, AXON_TIME_NOW, NULL));
    struct message message;
    CHECK(take(listener, &message));
    OK(axon_session_publisher_destroy(talker));
    OK(axon_session_subscription_destroy(listener));
    close_place(user->place);
    __atomic_store_n(&user->done, 1, __ATOMIC_SEQ_CST);
}

/* A callback ends all there is, called by who sets it or on the session's thread. */
static void end_from_within(int later) {
    struct place place = open_place("within");
    axon_publisher_t talker = publisher(place, "/callbacks");
    struct user *user = new_user();
    user->listener = subscription(place, "/callbacks");
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    if (later) {
        OK(axon_session_subscription_set_callback(user->listener, unset_own, user));
    }
    OK(axon_session_publisher_publish(talker, (const uint8_t *)"x", 1, AXON_TIME_NOW, NULL));
    if (!later) {
        OK(axon_session_subscription_set_callback(user->listener, unset_own, user));
    }
    until(&user->done);
    CHECK(user->told == 1);
    user->done = 0;
    user->place = place;
    struct message message;
    CHECK(take(user->listener, &message));
    if (later) {
        OK(axon_session_subscription_set_callback(user->listener, end_own, user));
    }
    OK(axon_session_publisher_publish(talker, (const uint8_t *)"x", 1, AXON_TIME_NOW, NULL));
    /* With it ends the session, once nothing of it is left but what the callback destroys. */
    OK(axon_session_publisher_destroy(talker));
    if (!later) {
        NO_HANDLE(axon_session_subscription_set_callback(user->listener, end_own, user));
    }
    until(&user->done);
    CHECK(user->told == 2);
    NO_HANDLE(axon_session_close(place.session));
    free_user(user);

    /* An event's, which tells where an endpoint comes. */
    place = open_place("within");
    talker = publisher(place, "/callbacks");
    user = new_user();
    user->place = place;
    OK(axon_session_publisher_event(talker, AXON_EVENT_PUBLICATION_MATCHED, &user->event));
    OK(axon_session_event_set_callback(user->event, end_own, user));
    axon_subscription_t listener = subscription(place, "/callbacks");
    until(&user->done);
    CHECK(user->told == 1);
    OK(axon_session_subscription_destroy(listener));
    OK(axon_session_publisher_destroy(talker));
    free_user(user);
}

void case_callbacks(void) {
    race_for_the_end();
    end_from_within(0);
    end_from_within(1);
}
