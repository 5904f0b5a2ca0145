/* Publishers, subscriptions, loans, and what is known of a sample. */
#include "check.h"

static const axon_gid_t no_gid;

void case_topics(void) {
    struct place place = open_place("topics");
    axon_endpoint_options_t options = endpoint("/topics");
    uint8_t hash[32] = {1, 2, 3};
    options.type_hash = hash;
    options.type_hash_size = sizeof hash;
    options.qos.durability = AXON_DURABILITY_TRANSIENT_LOCAL;
    options.qos.depth = 3;
    axon_publisher_t talker, mayfly;
    OK(axon_session_publisher_create(place.node, &options, &talker));
    options.topic = "/mayfly";
    options.qos.lifespan = UINT64_C(3600000000000);
    OK(axon_session_publisher_create(place.node, &options, &mayfly));
    axon_gid_t gid = no_gid;
    axon_qos_t qos;
    OK(axon_session_publisher_describe(talker, &gid, &qos));
    CHECK(memcmp(&gid, &no_gid, sizeof gid) != 0);
    CHECK(qos.reliability == AXON_RELIABILITY_RELIABLE);
    CHECK(qos.durability == AXON_DURABILITY_TRANSIENT_LOCAL);
    CHECK(qos.history == AXON_HISTORY_KEEP_LAST && qos.depth == 3);
    CHECK(qos.liveliness == AXON_LIVELINESS_AUTOMATIC);
    CHECK(qos.deadline == AXON_DURATION_INFINITE && qos.lease == AXON_DURATION_INFINITE);
    CHECK(qos.lifespan == AXON_DURATION_INFINITE);
    OK(axon_session_publisher_describe(mayfly, NULL, &qos));
    CHECK(qos.lifespan == options.qos.lifespan);
    /* Its age counts, not the time that it is stamped with. */
    axon_subscription_t late = subscription(place, "/mayfly");
    struct message message;
    OK(axon_session_publisher_wait_matched(mayfly, 1, PATIENCE));
    OK(axon_session_publisher_publish(mayfly, (const uint8_t *)"old", 3, 42, NULL));
    CHECK(take(late, &message) && message.info.reception_sequence == 1);
    OK(axon_session_publisher_destroy(mayfly));
    options.qos.lifespan = 1;
    OK(axon_session_publisher_create(place.node, &options, &mayfly));
    OK(axon_session_publisher_wait_matched(mayfly, 1, PATIENCE));
    OK(axon_session_publisher_publish(mayfly, (const uint8_t *)"new", 3, AXON_TIME_NOW, NULL));
    CHECK(!take(late, &message));
    OK(axon_session_subscription_destroy(late));
    OK(axon_session_publisher_destroy(mayfly));
    options.topic = "/topics";

    /* Best available is what the publisher offers. */
    memset(&options.qos, 0, sizeof options.qos);
    options.qos.reliability = AXON_CHOICE_BEST_AVAILABLE;
    options.qos.durability = AXON_CHOICE_BEST_AVAILABLE;
    options.qos.deadline = AXON_DURATION_BEST_AVAILABLE;
    axon_subscription_t listener;
    OK(axon_session_subscription_create(place.node, &options, &listener));
    axon_gid_t other;
    OK(axon_session_subscription_describe(listener, &other, &qos));
    CHECK(qos.durability == AXON_DURABILITY_TRANSIENT_LOCAL);
    CHECK(memcmp(&gid, &other, sizeof gid) != 0);
    OK(axon_session_subscription_describe(listener, NULL, NULL));

    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    OK(axon_session_subscription_wait_matched(listener, 1, PATIENCE));
    size_t matched = 0;
    OK(axon_session_publisher_matched(talker, &matched));
    CHECK(matched == 1);
    OK(axon_session_subscription_matched(listener, &matched));
    CHECK(matched == 1);
    RETURNS(AXON_RET_TIMEOUT, axon_session_publisher_wait_matched(talker, 2, 1), "/topics");
    RETURNS(AXON_RET_TIMEOUT, axon_session_subscription_wait_matched(listener, 2, 0), "/c/topics");

    CHECK(!take(listener, &message));
    uint64_t sequence = 0;
    OK(axon_session_publisher_publish(talker, (const uint8_t *)"hello", 5, 42, &sequence));
    CHECK(sequence == 1);
    OK(axon_session_publisher_publish(talker, NULL, 0, AXON_TIME_NOW, NULL));
    await(place, listener);
    CHECK(take(listener, &message));
    CHECK(message.len == 5 && memcmp(message.bytes, "hello", 5) == 0);
    CHECK(memcmp(&message.info.sender, &gid, sizeof gid) == 0);
    CHECK(message.info.publication_sequence == 1 && message.info.reception_sequence == 1);
    CHECK(message.info.source_timestamp == 42 && message.info.received_timestamp > 42);
    CHECK(message.info.own_session == 1);
    CHECK(take(listener, &message));
    CHECK(message.len == 0 && message.info.publication_sequence == 2);
    CHECK(message.info.reception_sequence == 2 && message.info.source_timestamp > 42);
    CHECK(!take(listener, &message));

    /* No room: the sample is gone, and the next one comes. */
    static uint8_t large[10000];
    memset(large, 'x', sizeof large);
    OK(axon_session_publisher_publish(talker, large, sizeof large, AXON_TIME_NOW, NULL));
    OK(axon_session_publisher_publish(talker, (const uint8_t *)"next", 4, AXON_TIME_NOW, NULL));
    uint8_t taken = 0;
    RETURNS(AXON_RET_BAD_ALLOC,
            axon_session_subscription_take(listener, room, &message, NULL, &taken), "/topics");
    CHECK(take(listener, &message) && message.len == 4);
    uint64_t lost = 7;
    OK(axon_session_subscription_lost(listener, &lost));
    CHECK(lost == 0);

    /* Where nobody reads, now or later, there is nothing to serialize. */
    uint64_t skipped = 7;
    OK(axon_session_publisher_skip_unread(talker, &skipped));
    CHECK(skipped == 0);
    axon_publisher_t lonely = publisher(place, "/lonely");
    OK(axon_session_publisher_skip_unread(lonely, &skipped));
    CHECK(skipped == 1);
    OK(axon_session_publisher_assert_liveliness(lonely));

    /* Not from its own session. */
    options = endpoint("/lonely");
    options.ignore_local = 1;
    axon_subscription_t deaf;
    OK(axon_session_subscription_create(place.node, &options, &deaf));
    struct place elsewhere = open_place("elsewhere");
    OK(axon_session_publisher_matched(lonely, &matched));
    CHECK(matched == 0);
    OK(axon_session_publisher_publish(lonely, (const uint8_t *)"me", 2, AXON_TIME_NOW, NULL));
    CHECK(!take(deaf, &message));

    OK(axon_session_subscription_destroy(deaf));
    OK(axon_session_publisher_destroy(lonely));
    OK(axon_session_subscription_destroy(listener));
    OK(axon_session_publisher_destroy(talker));
    close_place(elsewhere);
    close_place(place);
}

/* Where it was lent. */
static const uint8_t *publish_loan(axon_publisher_t talker, size_t header, size_t most,
                                   size_t len) {
    axon_loan_t loan;
    uint8_t *data = NULL;
    OK(axon_session_publisher_loan(talker, header, most, &loan, &data));
    CHECK(most == 0 || ((uintptr_t)data + header) % 16 == 0);
    for (size_t i = 0; i < most; i++) {
        data[i] = (uint8_t)(i * 7);
    }
    uint64_t sequence = 0;
    RETURNS(AXON_RET_INVALID_ARGUMENT, axon_session_loan_publish(loan, most + 1, 5, &sequence), "loan");
    OK(axon_session_loan_publish(loan, len, 5, &sequence));
    CHECK(sequence > 0);
    NO_HANDLE(axon_session_loan_publish(loan, len, 5, NULL));
    NO_HANDLE(axon_session_loan_abandon(loan));
    return data;
}

static void take_in_place(struct place place, axon_subscription_t listener, size_t header,
                          size_t len) {
    axon_sample_t sample;
    const uint8_t *data = NULL;
    size_t found = 0;
    axon_message_info_t info;
    await(place, listener);
    OK(axon_session_subscription_take_sample(listener, &sample, &data, &found, &info));
    CHECK(sample.id != 0 && found == len);
    CHECK(len == 0 || len > 4096 || (uintptr_t)data % 8 == 0);
    CHECK(len <= 4096 || ((uintptr_t)data + header) % 16 == 0);
    CHECK(info.source_timestamp == 5);
    for (size_t i = 0; i < len; i++) {
        CHECK(data[i] == (uint8_t)(i * 7));
    }
    OK(axon_session_sample_release(sample));
    NO_HANDLE(axon_session_sample_release(sample));
}

/* Those that are expected are in place from 513 bytes on. That a sample was not copied shows by
   its address, where publisher and subscription share one map: two at a time, so that none is where
   another one was. */
static void take_expected(struct place place) {
    axon_endpoint_options_t options = endpoint("/expected");
    options.expected_len = 513;
    axon_publisher_t talker;
    OK(axon_session_publisher_create(place.node, &options, &talker));
    axon_subscription_t listener = subscription(place, "/expected");
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    static const size_t sizes[] = {513, 1000, 4096, 4097};
    for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; i++) {
        const uint8_t *lent[2], *found[2];
        axon_sample_t samples[2];
        for (size_t one = 0; one < 2; one++) {
            lent[one] = publish_loan(talker, 4, sizes[i], sizes[i]);
        }
        for (size_t one = 0; one < 2; one++) {
            size_t len = 0;
            OK(axon_session_subscription_take_sample(listener, &samples[one], &found[one], &len,
                                                     NULL));
            CHECK(len == sizes[i] && found[one] == lent[one]);
        }
        for (size_t one = 0; one < 2; one++) {
            CHECK(found[one][512] == (uint8_t)(512 * 7));
            OK(axon_session_sample_release(samples[one]));
        }
    }
    OK(axon_session_subscription_destroy(listener));
    OK(axon_session_publisher_destroy(talker));
}

void case_loans(void) {
    struct place place = open_place("loans");
    axon_subscription_t listener = subscription(place, "/loans");
    axon_publisher_t talker = publisher(place, "/loans");
    OK(axon_session_publisher_wait_matched(talker, 1, PATIENCE));
    /* In shared memory, shortened there, shortened to what is copied, and short from the start. */
    static const size_t sizes[][2] = {{100000, 100000}, {100000, 60001}, {100000, 4096},
                                      {100000, 0},      {4096, 4096},    {100, 3},
                                      {0, 0},           {5000, 4097}};
    for (size_t round = 0; round < 20; round++) {
        for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; i++) {
            const size_t header = round * 4 % 17;
            publish_loan(talker, header, sizes[i][0], sizes[i][1]);
            take_in_place(place, listener, header, sizes[i][1]);
        }
    }
    axon_sample_t sample = {7};
    const uint8_t *data = NULL;
    size_t len = 0;
    OK(axon_session_subscription_take_sample(listener, &sample, &data, &len, NULL));
    CHECK(sample.id == 0 && data == NULL);

    take_expected(place);

    axon_loan_t loan;
    uint8_t *room_for = NULL;
    OK(axon_session_publisher_loan(talker, 0, 50000, &loan, &room_for));
    memset(room_for, 1, 50000);
    OK(axon_session_loan_abandon(loan));
    RETURNS(AXON_RET_INVALID_ARGUMENT,
            axon_session_publisher_loan(talker, 0, SIZE_MAX, &loan, &room_for), "/loans");

    /* What is taken outlives its subscription; what is lent, its publisher. */
    publish_loan(talker, 0, 20000, 20000);
    await(place, listener);
    OK(axon_session_subscription_take_sample(listener, &sample, &data, &len, NULL));
    OK(axon_session_publisher_loan(talker, 0, 20000, &loan, &room_for));
    OK(axon_session_publisher_destroy(talker));
    OK(axon_session_subscription_destroy(listener));
    close_place(place);
    CHECK(len == 20000 && data[19999] == (uint8_t)(19999 * 7));
    room_for[0] = room_for[19999] = 1;
    RETURNS(AXON_RET_INVALID_HANDLE, axon_session_loan_publish(loan, 20000, AXON_TIME_NOW, NULL),
            "publisher is destroyed");
    OK(axon_session_sample_release(sample));
}
