use super::*;

fn limits(rules: &AccessRules, party: Principal<'_>, verb: Verb, name: &str) -> Vec<String> {
    rules.permissions(party).limits(verb, name).map(PlacedLimit::to_string).collect()
}

#[test]
fn the_example_limit_applies_to_camera_publishers_and_subscriptions() {
    let rules = rules(
        r#"
[[limit]]
peer = "*"
topic = "/camera/**"
rate = 30          # messages a second, leaky bucket
bytes = "4 MB/s"
burst = 5
over = "drop-oldest"   # drop-newest, hold (KEEP_ALL alone)
"#,
    );
    let shown = ["line 2 of access.toml: 30 a second, 4 MB/s, 5 at once, drop-oldest"];
    for party in [Principal::Name("base"), Principal::Address([10, 0, 0, 1].into())] {
        for verb in [Verb::Publish, Verb::Subscribe] {
            assert_eq!(limits(&rules, party, verb, "/camera/left"), shown);
            assert!(limits(&rules, party, verb, "/scan").is_empty());
        }
        assert!(limits(&rules, party, Verb::Call, "/camera/left").is_empty());
        assert!(rules.check(party, Verb::Publish, "/camera/left").allowed());
    }
    assert!(rules.is_empty() && rules.limits_anything(), "nothing is denied");
    assert_eq!(rules.file(), Some("access.toml"));
}

#[test]
fn each_limit_that_names_the_peer_and_the_use_counts() {
    let rules = rules(
        "[[limit]]\npeer = \"guest-*\"\nbytes = \"1 MB/s\"\n\
         [[limit]]\npeer = [\"guest-1\", \"base\"]\nsubscribe = [\"/a\", \"/b/*\"]\nrate = 0.5\n\
         [[limit]]\npeer = \"base\"\ncall = \"/set\"\nrate = 2\nover = \"hold\"",
    );
    let lines = |party, verb, name| -> Vec<_> {
        let permissions = rules.permissions(Principal::Name(party));
        permissions.limits(verb, name).map(|limit| limit.line).collect()
    };
    assert_eq!(lines("guest-1", Verb::Subscribe, "/b/x"), [1, 4]);
    assert_eq!(lines("guest-1", Verb::Publish, "/b/x"), [1]);
    assert_eq!(lines("guest-2", Verb::Subscribe, "/a"), [1]);
    assert_eq!(lines("base", Verb::Subscribe, "/a"), [4]);
    assert_eq!(lines("base", Verb::Call, "/set"), [8]);
    let of_all = rules.permissions(Principal::Name("guest-2"));
    let of_all = of_all.limits(Verb::Subscribe, "/a").next().unwrap().limit.clone();
    assert!(of_all.together, "without topics it is about all of them together");
}

#[test]
fn each_wrong_limit_is_refused_with_its_line_and_column() {
    for (text, at, says) in [
        ("limit = 3", (1, 9), "write [[limit]]"),
        ("[[limit]]", (1, 1), "without peer"),
        ("[[limit]]\nrate = 1", (1, 1), "without peer"),
        ("[[limit]]\npeer = \"*\"", (1, 1), "without rate, bytes and egress"),
        ("[[limit]]\npeer = \"*\"\nrate = 0", (3, 8), "from 0.01 to 1000000"),
        ("[[limit]]\npeer = \"*\"\nrate = -1.5", (3, 8), "from 0.01"),
        ("[[limit]]\npeer = \"*\"\nrate = 0x20", (3, 8), "in decimal"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\nburst = 0b11", (4, 9), "in decimal"),
        ("[[limit]]\npeer = \"*\"\nrate = inf", (3, 8), "from 0.01"),
        ("[[limit]]\npeer = \"*\"\nrate = \"30\"", (3, 8), "a number"),
        ("[[limit]]\npeer = \"*\"\nbytes = 4", (3, 9), "such as \"4 MB/s\""),
        ("[[limit]]\npeer = \"*\"\nbytes = \"4 MB\"", (3, 9), "MB/s"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\nburst = 0", (4, 9), "from 1 to 100000"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\nburst = 1.5", (4, 9), "whole number"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\nover = \"drop\"", (4, 8), "drop-oldest"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\nover = 1", (4, 8), "a string"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\ntogether = 1", (4, 12), "true, false"),
        ("[[limit]]\npeer = \"local\"\nrate = 1", (2, 8), "within a host"),
        ("[[limit]]\ninterface = \"wlan0\"", (1, 1), "write interface and egress alone"),
        ("[[limit]]\ninterface = \"wlan0\"\nrate = 1", (1, 1), "write interface and egress alone"),
        (
            "[[limit]]\ninterface = \"wlan0\"\npeer = \"*\"\negress = \"1 MB/s\"",
            (1, 1),
            "write interface and egress alone",
        ),
        (
            "[[limit]]\ninterface = \"wlan0\"\ntopic = \"/a\"\negress = \"1 MB/s\"",
            (1, 1),
            "peer or interface alone",
        ),
        ("[[limit]]\ninterface = \"a/b\"\negress = \"1 MB/s\"", (2, 13), "1 to 15 bytes"),
        ("[[limit]]\ninterface = \"\"\negress = \"1 MB/s\"", (2, 13), "1 to 15 bytes"),
        ("[[limit]]\ninterface = \"0123456789abcdef\"\negress = \"1 MB/s\"", (2, 13), "1 to 15"),
        ("[[limit]]\ninterface = []\negress = \"1 MB/s\"", (2, 13), "interface"),
        ("[[limit]]\npeer = \"uid:3\"\nrate = 1", (2, 8), "within a host"),
        ("[[limit]]\npeer = \"*\"\nrate = 1\ntopic = \"a\"", (4, 9), "topic \"a\""),
        ("[[limit]]\npeer = \"*\"\nrate = 1\ncall = \"/a\"", (1, 1), "over = \"hold\""),
        (
            "[[limit]]\npeer = \"*\"\nrate = 1\ncall = \"/a\"\ntopic = \"/b\"\nover = \"hold\"",
            (1, 1),
            "no topic",
        ),
        ("[[limit]]\npeer = \"*\"\negress = 3", (3, 10), "such as"),
        ("[[limit]]\npeer = \"*\"\negress = \"9 kB/s\"", (3, 10), "10 kB/s at least"),
        (
            "[[limit]]\npeer = \"*\"\negress = \"1 MB/s\"\nrate = 1",
            (1, 1),
            "peer or interface alone",
        ),
        ("[[limit]]\npeer = \"*\"\negress = \"1 MB/s\"\ntopic = \"/a\"", (1, 1), "interface alone"),
        ("[[limit]]\npeer = \"*\"\nserve = \"/a\"", (3, 1), "unknown key"),
    ] {
        let AccessError { line, column, what, .. } = error(text);
        assert_eq!((line, column), at, "{text}: {what}");
        assert!(what.contains(says), "{text}: {what}");
    }
}

#[test]
fn egress_limits_all_that_is_sent_and_no_topic() {
    let rules = rules(
        "[[limit]]\npeer = \"guest\"\negress = \"2 MB/s\"\n[[limit]]\npeer = \"*\"\negress = \"54 Mbit/s\"",
    );
    let of = |name| -> Vec<_> {
        let permissions = rules.permissions(Principal::Name(name));
        assert_eq!(permissions.limits(Verb::Subscribe, "/a").count(), 0);
        permissions.egress().map(|limit| (limit.line, limit.to_string())).collect()
    };
    assert_eq!(of("guest"), [(1, "2 MB/s".to_owned()), (4, "6.75 MB/s".to_owned())]);
    assert_eq!(of("base"), [(4, "6.75 MB/s".to_owned())]);
}

#[test]
fn a_limit_of_interfaces_is_about_no_peer() {
    let rules = rules(
        "[[limit]]\ninterface = [\"wl*\", \"usb0\"]\negress = \"2 MB/s\"\n\
         [[limit]]\ninterface = \"wlan0\"\negress = \"20 Mbit/s\"",
    );
    let lines = |name| -> Vec<_> {
        let all = rules.interface_limits().iter().filter(|limit| limit.names(name));
        all.map(|limit| (limit.limit.line, limit.limit.bytes)).collect()
    };
    assert_eq!(lines("wlan0"), [(1, 2e6), (4, 2.5e6)]);
    assert_eq!(lines("usb0"), [(1, 2e6)]);
    assert!(lines("eth0").is_empty());
    let permissions = rules.permissions(Principal::Name("base"));
    assert!(permissions.egress().next().is_none());
    assert!(rules.is_empty() && rules.limits_anything());
    assert_eq!(rules.file(), Some("access.toml"));
}
