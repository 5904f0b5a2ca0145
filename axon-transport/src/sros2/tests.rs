//! Tests grants against a model, and hostile documents.

use std::{
    os::unix::fs::{PermissionsExt, symlink},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use proptest::prelude::*;

use super::{EnclavePermissions, PermissionsError, names::TopicUse};
use crate::graph::EndpointKind;

/// Returns 2026-06-01.
fn now() -> SystemTime {
    UNIX_EPOCH + Duration::from_secs(1_780_272_000)
}

const VALID: &str = "<validity><not_before>2026-01-01T00:00:00</not_before>\
                     <not_after>2027-01-01T00:00:00</not_after></validity>";

/// Returns a file with these parts of a grant for `/arm`, one line each.
fn file(parts: &str) -> String {
    format!(
        "<dds xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\"><permissions>\n<grant name=\"/arm\">\n\
         <subject_name>CN=/arm</subject_name>\n{parts}\n</grant></permissions></dds>"
    )
}

fn grant(rules: &str, default: &str) -> String {
    file(&format!("{VALID}\n{rules}\n<default>{default}</default>"))
}

fn rule(kind: &str, does: &str, topics: &[&str]) -> String {
    let topics: String = topics.iter().map(|topic| format!("<topic>{topic}</topic>\n")).collect();
    format!(
        "<{kind}_rule><domains><id>0</id></domains>\n<{does}><topics>\n{topics}</topics></{does}></{kind}_rule>\n"
    )
}

fn parse(text: &str) -> Result<EnclavePermissions, PermissionsError> {
    EnclavePermissions::parse(text, "/k/permissions.p7s", "/arm")
}

fn refused(text: &str) -> String {
    let said = parse(text).unwrap_err().to_string();
    assert!(!said.contains('\n'), "{said}");
    said
}

fn may(text: &str, kind: EndpointKind, name: &str) -> bool {
    parse(text).unwrap().check(kind, name, 0, now()).is_ok()
}

#[test]
fn the_first_rule_that_fits_decides_and_else_the_default() {
    let allow = rule("allow", "publish", &["rt/arm/*"]);
    let deny = rule("deny", "publish", &["rt/arm/stop", "rt/other"]);
    for (rules, stop) in [(format!("{allow}{deny}"), true), (format!("{deny}{allow}"), false)] {
        for (default, rest) in [("ALLOW", true), ("DENY", false)] {
            let text = grant(&rules, default);
            let publish = |name| may(&text, EndpointKind::Publisher, name);
            assert!(publish("/arm/go"));
            assert_eq!(publish("/arm/stop"), stop);
            assert!(!publish("/other"));
            assert_eq!(publish("/leg"), rest);
            assert_eq!(may(&text, EndpointKind::Subscription, "/arm/stop"), rest);
            assert!(may(&text, EndpointKind::Node, ""));
        }
    }
}

#[test]
fn a_client_and_a_server_need_both_halves() {
    let half = |does, topics| rule("allow", does, topics);
    let cases = [
        (half("publish", &["rq/addRequest"]) + &half("subscribe", &["rr/addReply"]), true, false),
        (half("subscribe", &["rq/addRequest"]) + &half("publish", &["rr/addReply"]), false, true),
        (half("publish", &["rq/addRequest", "rr/addReply"]), false, false),
        (half("subscribe", &["rq/addRequest", "rr/addReply"]), false, false),
        (half("publish", &["*"]) + &half("subscribe", &["*"]), true, true),
    ];
    for (rules, client, server) in cases {
        let text = grant(&rules, "DENY");
        assert_eq!(may(&text, EndpointKind::Client, "/add"), client, "{rules}");
        assert_eq!(may(&text, EndpointKind::Server, "/add"), server, "{rules}");
    }
}

#[test]
fn a_name_that_avoids_the_conventions_of_ros_has_no_prefix() {
    let text = grant(&rule("allow", "publish", &["Square", "rt/Circle"]), "DENY");
    for (name, allowed) in
        [("Square", true), ("/Square", false), ("Circle", false), ("/Circle", true)]
    {
        assert_eq!(may(&text, EndpointKind::Publisher, name), allowed, "{name}");
    }
}

#[test]
fn a_denial_names_enclave_topic_file_and_line() {
    let rules = rule("deny", "publish", &["rt/a", "rt/b"]);
    let permissions = parse(&grant(&rules, "DENY")).unwrap();
    let denial = |name| permissions.check(EndpointKind::Publisher, name, 0, now()).unwrap_err();
    assert_eq!(
        denial("/b").to_string(),
        "enclave /arm may not publish rt/b: denied by line 8 of /k/permissions.p7s"
    );
    assert_eq!(
        denial("/c").to_string(),
        "enclave /arm may not publish rt/c: no rule allows it, and line 11 of /k/permissions.p7s denies the rest"
    );
    assert_eq!((denial("/a").line(), denial("/c").line()), (7, 11));
    let subscription = permissions.check(EndpointKind::Subscription, "/b", 0, now()).unwrap_err();
    assert!(subscription.to_string().contains("may not subscribe to rt/b"), "{subscription}");
}

#[test]
fn a_rule_counts_in_its_domains_alone() {
    let of = |domains: &str| {
        let rule = rule("allow", "publish", &["*"]);
        grant(&rule.replace("<id>0</id>", domains), "DENY")
    };
    for (domains, inside, outside) in [
        ("<id>3</id><id>5</id>", vec![3, 5], vec![0, 4]),
        ("<id_range><min>3</min><max>5</max></id_range>", vec![3, 4, 5], vec![2, 6]),
        ("<id_range><min>3</min></id_range>", vec![3, 232], vec![2]),
        ("<id_range><max>3</max></id_range>", vec![0, 3], vec![4]),
        ("<id_range><min>5</min><max>3</max></id_range>", vec![], vec![3, 4, 5]),
    ] {
        let permissions = parse(&of(domains)).unwrap();
        for (all, allowed) in [(inside, true), (outside, false)] {
            for domain in all {
                let checked = permissions.check(EndpointKind::Publisher, "/a", domain, now());
                assert_eq!(checked.is_ok(), allowed, "{domains} {domain}");
                assert_eq!(permissions.check_domain(domain, now()).is_ok(), allowed);
            }
        }
    }
    let said = parse(&of("<id>3</id><id_range><min>7</min></id_range>")).unwrap();
    let said = said.check_domain(0, now()).unwrap_err().to_string();
    assert!(said.contains("allow nothing in domain 0, but in 3, 7 and above (line 2)"), "{said}");
    for (wrong, why) in [
        ("", "no domain"),
        ("<id>-1</id>", "accepted: numbers"),
        ("<id>4294967296</id>", "accepted: numbers"),
        ("<id_range/>", "without min and max"),
        ("<all/>", "element <all> is not known"),
    ] {
        assert!(refused(&of(wrong)).contains(why), "{wrong}");
    }
    // The rule only denies; the default decides whether the participant may be in the domain.
    let deny = rule("deny", "publish", &["rt/a"]);
    parse(&grant(&deny, "ALLOW")).unwrap().check_domain(7, now()).unwrap();
    parse(&grant(&deny, "DENY")).unwrap().check_domain(0, now()).unwrap_err();
}

#[test]
fn the_partition_without_a_name_is_the_one_that_counts() {
    let of = |kind: &str, partitions: &str| {
        let rule = rule(kind, "publish", &["rt/a"])
            .replace("</publish>", &format!("{partitions}</publish>"));
        grant(&rule, if kind == "allow" { "DENY" } else { "ALLOW" })
    };
    let all = |names: &[&str]| {
        let names: String =
            names.iter().map(|name| format!("<partition>{name}</partition>")).collect();
        format!("<partitions>{names}</partitions>")
    };
    for (partitions, fits) in [
        (String::new(), true),
        (all(&[""]), true),
        (all(&["*"]), true),
        (all(&["left", "**"]), true),
        (all(&["left"]), false),
        (all(&["?*"]), false),
    ] {
        assert_eq!(
            may(&of("allow", &partitions), EndpointKind::Publisher, "/a"),
            fits,
            "{partitions}"
        );
        assert_eq!(
            may(&of("deny", &partitions), EndpointKind::Publisher, "/a"),
            !fits,
            "{partitions}"
        );
    }
    assert!(refused(&of("deny", "<partitions/>")).contains("line 6: no partition"));
}

#[test]
fn permissions_count_between_their_dates() {
    let permissions = parse(&grant(&rule("allow", "publish", &["*"]), "DENY")).unwrap();
    let at = |seconds| UNIX_EPOCH + Duration::from_secs(seconds);
    let (first, last) = (1_767_225_600, 1_798_761_600);
    for (seconds, valid) in
        [(first - 1, false), (first, true), (last, true), (last + 1, false), (0, false)]
    {
        let checked = permissions.check(EndpointKind::Publisher, "/a", 0, at(seconds));
        assert_eq!(checked.is_ok(), valid, "{seconds}");
        assert_eq!(permissions.check_domain(0, at(seconds)).is_ok(), valid, "{seconds}");
        let Err(denial) = checked else { continue };
        let dates = "valid from 2026-01-01T00:00:00 to 2027-01-01T00:00:00 UTC, by line 4 of /k/permissions.p7s";
        assert!(denial.to_string().ends_with(dates), "{denial}");
    }
    let before = permissions.check_domain(0, UNIX_EPOCH - Duration::from_secs(1)).unwrap_err();
    assert!(before.to_string().contains("(line 4)"), "{before}");
}

#[test]
fn of_several_grants_the_first_that_is_valid_counts() {
    let of = |subject: &str, year: u32, topic: &str| {
        format!(
            "<grant name=\"x\"><subject_name>{subject}</subject_name>\
             <validity><not_before>{year}-01-01T00:00:00Z</not_before>\
             <not_after>{}-01-01T00:00:00+01:00</not_after></validity>{}<default>DENY</default></grant>",
            year + 1,
            rule("allow", "publish", &[topic])
        )
    };
    let text = format!(
        "<dds><permissions>{}{}{}{}</permissions></dds>",
        of("CN=/leg", 2026, "rt/leg"),
        of("CN=/arm", 2025, "rt/old"),
        of("O=robots, CN=/arm", 2026, "rt/first"),
        of("CN=/arm", 2026, "rt/second")
    );
    for (name, allowed) in [("/first", true), ("/second", false), ("/old", false), ("/leg", false)]
    {
        assert_eq!(may(&text, EndpointKind::Publisher, name), allowed, "{name}");
    }
    let said = EnclavePermissions::parse(&text, "p", "/tail").unwrap_err().to_string();
    assert!(said.contains("CN=/tail, but CN=/leg; CN=/arm; O=robots, CN=/arm"), "{said}");
    // The name of a grant does not identify an enclave.
    EnclavePermissions::parse(&text, "p", "x").unwrap_err();
}

#[test]
fn permissions_with_unknown_or_invalid_elements_are_refused() {
    let allow = rule("allow", "publish", &["*"]);
    let with = |element: &str| {
        grant(&allow.replace("</allow_rule>", &format!("{element}</allow_rule>")), "DENY")
    };
    let default = "<default>DENY</default>";
    for (text, why) in [
        (with("<surprise/>"), "line 8: element <surprise> is not known"),
        (with("<publish><topics/></publish>"), "line 8: no topic"),
        (with("<publish><topics><topic>rt/<b/>a</topic></topics></publish>"), "<b> is not known"),
        (with("<publish><topics><topic>rt/a\\</topic></topics></publish>"), "backslash"),
        (with("<publish><topics><topic>a</topic></topics><data_tags/></publish>"), "data_tags"),
        (with("<domains><id>1</id></domains>"), "in one <domains>, and not in 2"),
        (allow.replace("<domains><id>0</id></domains>", ""), "not in 0"),
        (grant("<surprise/>", "DENY"), "line 5: element <surprise>"),
        (grant(&allow, "allow"), "accepted: ALLOW, DENY"),
        (file(&format!("{VALID}{allow}")), "no <default>"),
        (file(&format!("{allow}{default}")), "no <validity>"),
        (file(&format!("{VALID}{VALID}{allow}{default}")), "a second <validity>"),
        (file(&format!("{VALID}{allow}{default}<default>ALLOW</default>")), "a second <default>"),
        (grant(&allow, "DENY").replace("2027-01-01T", "2027-01-41T"), "accepted: a date"),
        (grant(&allow, "DENY").replace("<subject_name>CN=/arm</subject_name>", ""), "no grant"),
    ] {
        let text = if text.starts_with("<allow") { grant(&text, "DENY") } else { text };
        assert!(refused(&text).contains(why), "{why}: {}", refused(&text));
    }
    // A known element for something that AXON does not do.
    parse(&with("<relay><topics><topic>*</topic></topics></relay>")).unwrap();
}

#[test]
fn a_document_that_wants_to_do_harm_is_refused() {
    let deep = |count: usize| format!("<dds>{}{}</dds>", "<a>".repeat(count), "</a>".repeat(count));
    let bomb = "<!DOCTYPE dds [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;&a;\">]><dds>&b;</dds>";
    let outside = "<!DOCTYPE dds SYSTEM \"file:///etc/passwd\"><dds/>";
    let attributes: String = (0..100_000).map(|n| format!(" a{n}=\"\"")).collect();
    let spaces: String = (0..40).map(|n| format!(" xmlns:a{n}=\"b\"")).collect();
    let name = format!("rt/{}", "a".repeat(64 << 10));
    let half = "<topic>*</topic>".repeat(5_000);
    let half = rule("allow", "publish", &["*"]).replace("<topic>*</topic>", &half);
    let twice = grant(&half, "DENY");
    let inside = &twice[twice.find("<grant").unwrap()..twice.find("</permissions>").unwrap()];
    let twice = twice.replace("</permissions>", &format!("{inside}</permissions>"));
    for (text, why) in [
        (String::new(), "not XML"),
        ("<dds>".to_owned(), "not XML"),
        ("<dds>&lol;</dds>".to_owned(), "not XML"),
        ("<policy/>".to_owned(), "its first element is <policy>"),
        (bomb.to_owned(), "it has a DTD"),
        (outside.to_owned(), "it has a DTD"),
        (deep(20), "deeper than 16"),
        (deep(100_000), "deeper than 16"),
        (format!("<dds{attributes}/>"), "a tag of more than"),
        (format!("<dds{spaces}/>"), "declarations of namespaces"),
        (
            grant(&rule("allow", "publish", &[&name]), "DENY"),
            "line 7: a topic's expression longer than",
        ),
        (grant(&format!("{half}{half}"), "DENY"), "more than 8192 expressions"),
        (twice, "more than 8192 expressions"),
    ] {
        assert!(refused(&text).contains(why), "{why}: {}", refused(&text));
    }
    let long = "n".repeat(64 << 10);
    let subject = grant("", "DENY").replace("CN=/arm", &format!("CN=/{long}\u{202e}&#10;x"));
    assert!(refused(&subject).len() < 2_000);
}

#[test]
fn world_writable_missing_or_irregular_permissions_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("permissions.p7s");
    let read = || EnclavePermissions::read(&path, "/arm").map_err(|error| error.to_string());
    assert!(read().unwrap_err().contains("ros2 security create_enclave"));
    let text = grant(&rule("allow", "publish", &["*"]), "DENY");
    std::fs::write(&path, &text).unwrap();
    let mode = |mode| std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).unwrap();
    mode(0o666);
    assert!(read().unwrap_err().contains("everybody may write it"));
    mode(0o664);
    read().unwrap();
    std::fs::write(&path, "\u{e4}".as_bytes()[..1].repeat(3)).unwrap();
    assert!(read().unwrap_err().contains("not UTF-8"));
    std::fs::write(&path, format!("{text}{}", " ".repeat(1 << 20))).unwrap();
    assert!(read().unwrap_err().contains("larger than 1 MiB"));
    // A pipe that no process writes to, and an endless file.
    std::fs::remove_file(&path).unwrap();
    rustix::fs::mkfifoat(rustix::fs::CWD, &path, rustix::fs::Mode::RUSR).unwrap();
    assert!(read().unwrap_err().contains("not a regular file"));
    std::fs::remove_file(&path).unwrap();
    symlink("/dev/zero", &path).unwrap();
    assert!(read().unwrap_err().contains("not a regular file"));
    std::fs::remove_file(&path).unwrap();
    std::fs::create_dir(&path).unwrap();
    assert!(read().unwrap_err().contains("not a regular file"));
}

/// A rule of the model.
#[derive(Clone, Debug)]
struct Drawn {
    allows: bool,
    domains: (u32, u32),
    does: TopicUse,
    topics: Vec<String>,
    /// `None` for no element.
    partition: Option<String>,
}

impl Drawn {
    fn xml(&self) -> String {
        let kind = if self.allows { "allow_rule" } else { "deny_rule" };
        let does = if self.does == TopicUse::Publish { "publish" } else { "subscribe" };
        let topics: String =
            self.topics.iter().map(|one| format!("<topic>{one}</topic>")).collect();
        let partition = self.partition.as_ref().map_or(String::new(), |name| {
            format!("<partitions><partition>{name}</partition></partitions>")
        });
        let (min, max) = self.domains;
        format!(
            "<{kind}><domains><id_range><min>{min}</min><max>{max}</max></id_range></domains>\
             <{does}><topics>{topics}</topics>{partition}</{does}></{kind}>"
        )
    }
}

/// Implements POSIX's definition: a star matches nothing, or one character and then a star again.
fn fnmatch(pattern: &[u8], name: &[u8]) -> bool {
    match (pattern.first(), name.first()) {
        (None, None) => true,
        (Some(b'*'), first) => {
            fnmatch(&pattern[1..], name) || first.is_some() && fnmatch(pattern, &name[1..])
        }
        (Some(b'?'), Some(_)) => fnmatch(&pattern[1..], &name[1..]),
        (Some(one), Some(other)) => one == other && fnmatch(&pattern[1..], &name[1..]),
        _ => false,
    }
}

fn drawn() -> impl Strategy<Value = Drawn> {
    let topics = prop::collection::vec("(r[tqr])?[/ab*?]{0,4}(Request|Reply)?", 1..4);
    let does = prop_oneof![Just(TopicUse::Publish), Just(TopicUse::Subscribe)];
    (any::<bool>(), (0u32..4, 0u32..4), does, topics, prop::option::of("[a*]{0,2}")).prop_map(
        |(allows, domains, does, topics, partition)| Drawn {
            allows,
            domains,
            does,
            topics,
            partition,
        },
    )
}

proptest! {
    #[test]
    fn a_grant_decides_as_the_model_does(
        rules in prop::collection::vec(drawn(), 0..6),
        default: bool,
        names in prop::collection::vec("/?[ab](/[ab]){0,2}", 1..6),
        domain in 0u32..4,
    ) {
        let text: String = rules.iter().map(Drawn::xml).collect();
        let permissions = parse(&grant(&text, if default { "ALLOW" } else { "DENY" })).unwrap();
        let allowed = |does: TopicUse, topic: String| {
            let fits = |rule: &&Drawn| {
                (rule.domains.0..=rule.domains.1).contains(&domain)
                    && rule.does == does
                    && rule.topics.iter().any(|one| fnmatch(one.as_bytes(), topic.as_bytes()))
                    && rule.partition.as_ref().is_none_or(|one| fnmatch(one.as_bytes(), b""))
            };
            rules.iter().find(fits).map_or(default, |rule| rule.allows)
        };
        for name in names {
            let ros = |prefix: &str, suffix: &str| {
                let prefix = if name.starts_with('/') { prefix } else { "" };
                format!("{prefix}{name}{suffix}")
            };
            let topic = |does| allowed(does, ros("rt", ""));
            let halves = |requests, replies| {
                allowed(requests, ros("rq", "Request")) && allowed(replies, ros("rr", "Reply"))
            };
            for (kind, expected) in [
                (EndpointKind::Publisher, topic(TopicUse::Publish)),
                (EndpointKind::Subscription, topic(TopicUse::Subscribe)),
                (EndpointKind::Client, halves(TopicUse::Publish, TopicUse::Subscribe)),
                (EndpointKind::Server, halves(TopicUse::Subscribe, TopicUse::Publish)),
            ] {
                let checked = permissions.check(kind, &name, domain, now());
                prop_assert_eq!(checked.is_ok(), expected, "{:?} {}: {:?}", kind, name, checked);
            }
        }
    }
}
