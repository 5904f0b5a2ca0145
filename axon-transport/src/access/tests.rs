use proptest::prelude::*;

use super::*;

mod limits;
mod model;

fn rules(text: &str) -> AccessRules {
    AccessRules::parse(text, "access.toml").unwrap()
}

fn error(text: &str) -> AccessError {
    AccessRules::parse(text, "access.toml").unwrap_err()
}

/// The robot example of the issue that requested rules.
const ROBOT: &str = r#"
[[allow]]
peer = ["base", "sae-base", "operator-*"]
publish = ["/cmd_vel", "/robot/**"]
call = ["/robot/*/set_mode"]
subscribe = ["/scan", "/tf", "/tf_static", "/camera/**"]

[[allow]]
peer = "local"
subscribe = "/**"

[[deny]]
peer = "operator-guest"
publish = "/cmd_vel"
"#;

#[test]
fn the_example_lets_the_base_publish_and_the_guest_subscribe() {
    let rules = rules(ROBOT);
    let check = |party, verb, name| rules.check(party, verb, name).to_string();
    let base = Principal::Name("base");
    assert_eq!(check(base, Verb::Publish, "/cmd_vel"), "allowed by line 4 of access.toml");
    assert_eq!(check(base, Verb::Call, "/robot/arm/set_mode"), "allowed by line 5 of access.toml");
    let none = "denied: no [[allow]] in access.toml permits this";
    assert_eq!(check(base, Verb::Call, "/robot/arm/left/set_mode"), none);
    assert_eq!(check(base, Verb::Subscribe, "/cmd_vel"), none);
    let guest = Principal::Name("operator-guest");
    assert_eq!(check(guest, Verb::Publish, "/cmd_vel"), "denied by line 14 of access.toml");
    assert!(rules.check(guest, Verb::Subscribe, "/scan").allowed());
    let user = Principal::User(1001);
    assert!(rules.check(user, Verb::Subscribe, "/anything").allowed());
    assert_eq!(check(user, Verb::Publish, "/anything"), none);
    let other = check(Principal::Name("stranger"), Verb::Publish, "/cmd_vel");
    assert_eq!(other, "allowed: no rule in access.toml denies this");
    let closed = format!("default = \"deny\"\n{ROBOT}");
    let closed = AccessRules::parse(&closed, "access.toml").unwrap();
    let other = closed.check(Principal::Name("stranger"), Verb::Publish, "/cmd_vel");
    let by_default = "denied: default = \"deny\" in access.toml, and no [[allow]] names the peer";
    assert_eq!((other.to_string(), other.line()), (by_default.to_owned(), None));
}

#[test]
fn without_rules_all_is_allowed_and_a_file_without_any_is_refused() {
    assert!(AccessRules::default().permissions(Principal::User(1)).are_unrestricted());
    for text in ["", "# nothing", "[[expect]]\npeer = \"a\"\nsee = \"/x\"\nallowed = true"] {
        assert!(error(text).what.contains("no rules"), "{text}");
    }
    let open = rules("default = \"allow\"");
    assert!(!open.is_empty() && open.check(Principal::Name("a"), Verb::See, "/x").allowed());
    let closed = rules("default = \"deny\"");
    for verb in Verb::ALL {
        assert!(!closed.check(Principal::Name("a"), verb, "/x").allowed());
    }
}

#[test]
fn one_line_lets_a_peer_use_an_action_or_serve_it_or_set_parameters() {
    let rules = rules(
        r#"
        [[allow]]
        peer = "client"
        act = "/dock"
        parameters = ["/robot/**"]
        lifecycle = true
        [[allow]]
        peer = "server"
        serve = "/dock"
        "#,
    );
    let all = |party, verb: Verb, names: &[&str]| {
        names.iter().all(|name| rules.check(Principal::Name(party), verb, name).allowed())
    };
    let services = ["send_goal", "cancel_goal", "get_result"].map(|s| format!("/dock/_action/{s}"));
    let services = services.each_ref().map(String::as_str);
    let topics = ["/dock/_action/feedback", "/dock/_action/status"];
    assert!(all("client", Verb::Call, &services) && all("client", Verb::Subscribe, &topics));
    assert!(all("server", Verb::Serve, &services) && all("server", Verb::Publish, &topics));
    assert!(all("server", Verb::Serve, &["/dock"]));
    assert!(!all("client", Verb::Publish, &topics) && !all("client", Verb::Serve, &services));
    assert!(!all("client", Verb::Call, &["/other/_action/send_goal"]));
    assert!(all("client", Verb::Call, &["/robot/arm/set_parameters", "/robot/get_parameters"]));
    assert!(!all("client", Verb::Call, &["/other/set_parameters"]));
    assert!(all("client", Verb::Subscribe, &["/parameter_events", "/any/transition_event"]));
    assert!(all("client", Verb::Call, &["/any/change_state"]));
    assert!(all("client", Verb::See, &["/robot/arm", "/any"]));
}

#[test]
fn denied_parameters_or_lifecycle_block_only_these_services_of_the_node() {
    for (names, node) in [("true", "/robot/arm"), ("\"/robot/arm\"", "/robot/arm")] {
        let rules = rules(&format!(
            "[[deny]]\npeer = \"base\"\nparameters = {names}\n[[deny]]\npeer = \"manager\"\nlifecycle = {names}"
        ));
        let check = |party, verb, name: &str| rules.check(Principal::Name(party), verb, name);
        for service in ros::PARAMETER_SERVICES {
            let decision = check("base", Verb::Call, &format!("{node}/{service}"));
            assert_eq!(decision.line(), Some(3), "{names} {service}");
        }
        for service in ros::LIFECYCLE_SERVICES {
            let decision = check("manager", Verb::Call, &format!("{node}/{service}"));
            assert_eq!(decision.line(), Some(6), "{names} {service}");
        }
        let told = format!("{node}/{}", ros::LIFECYCLE_TOPIC);
        assert!(!check("manager", Verb::Subscribe, &told).allowed());
        assert!(check("base", Verb::Subscribe, ros::PARAMETER_EVENTS).allowed(), "of all nodes");
        for party in ["base", "manager"] {
            for verb in Verb::ALL {
                // A topic may have the name of a node.
                for name in [node, "/scan"] {
                    assert!(check(party, verb, name).allowed(), "{names} {party} {verb} {name}");
                }
            }
            assert!(check(party, Verb::See, &format!("{node}/set_parameters")).allowed());
        }
    }
}

#[test]
fn a_pattern_of_one_kind_fits_no_party_of_another() {
    let rules = rules(
        r#"
        default = "deny"
        [[allow]]
        peer = ["uid:1001", "address:10.0.0.*", "Base.Example", "local*"]
        see = "**"
        "#,
    );
    let sees = |party| rules.check(party, Verb::See, "/x").allowed();
    assert!(sees(Principal::User(1001)) && !sees(Principal::User(1002)));
    assert!(!sees(Principal::Name("uid:1001")) && !sees(Principal::Name("address:10.0.0.1")));
    assert!(sees(Principal::Address([10, 0, 0, 7].into())));
    assert!(sees(Principal::Address("::ffff:10.0.0.7".parse().unwrap())));
    assert!(!sees(Principal::Address([10, 0, 1, 7].into())));
    let other = "default = \"deny\"\n[[allow]]\npeer = [\"address:FE80::1\", \"address:::ffff:10.1.1.1\"]\nsee = \"**\"";
    let other = AccessRules::parse(other, "f").unwrap();
    for address in ["fe80::1", "10.1.1.1"] {
        let party = Principal::Address(address.parse().unwrap());
        assert!(other.check(party, Verb::See, "/x").allowed(), "{address}");
    }
    assert!(sees(Principal::Certificate("base.example")) && sees(Principal::Name("Base.Example")));
    assert!(!sees(Principal::Name("base.example")), "another pin");
    assert!(sees(Principal::Name("localhost")), "a host may have a name that begins with local");
    assert!(sees(Principal::Name("local")) && !sees(Principal::User(7)), "local* is a host's name");
}

#[test]
fn each_error_names_its_line_and_column() {
    for (text, line, column, what) in [
        ("[[allow]]\npublish = \"/x\"", 1, 1, "[[allow]] without peer"),
        ("[[allow]]\npeer = \"a\"\npublsh = \"/x\"", 3, 1, "unknown key \"publsh\""),
        ("[[allow]]\npeer = \"a\"\npublish = [\"/x\", \"y\"]", 3, 18, "publish \"y\""),
        ("[[allow]]\npeer = \"a\"\npublish = [\"/x\", 3]", 3, 18, "an array of strings"),
        ("[[allow]]\npeer = \"a\"\npublish = []", 3, 11, "an array of strings"),
        ("[[allow]]\npeer = \"uid:root\"", 2, 8, "uid: and a number"),
        ("[[allow]]\npeer = \"Local\"", 2, 8, "in lower case"),
        ("[[allow]]\npeer = \"UID:7\"", 2, 8, "in lower case"),
        ("[[expect]]\npeer = \"op-*\"\nsee = \"/x\"\nallowed = true", 2, 8, "without *"),
        ("[[allow]]\npeer = \"\"", 2, 8, "1 to 255 bytes"),
        ("[[deny]]\npeer = \"a\"", 1, 1, "denies nothing"),
        ("[[deny]]\npeer = \"a\"\nparameters = false", 1, 1, "denies nothing"),
        ("default = \"no\"", 1, 11, "\"allow\" or \"deny\""),
        ("[allow]\npeer = \"a\"", 1, 1, "write [[allow]]"),
        ("allow = [3]", 1, 10, "write [[allow]]"),
        ("[[alow]]\npeer = \"a\"", 1, 3, "unknown key \"alow\""),
        ("# é\n[[deny]]\npeer = \"é\" x", 3, 12, ""),
        ("[[expect]]\npeer = \"a\"\npublish = \"/x\"", 1, 1, "[[expect]] has"),
        ("[[allow]]\npeer = \"address:10.0.0.0/24\"", 2, 8, "address"),
        ("[[allow]]\npeer = \"address:base\"", 2, 8, "address"),
        ("[[allow]]\npeer = \"address:10.0.0.*/24\"", 2, 8, "address"),
        ("[[expect]]\npeer = \"local\"\npublish = \"/x\"\nallowed = true", 2, 8, "uid:"),
    ] {
        let error = error(text);
        assert_eq!((error.line, error.column), (line, column), "{text} {error}");
        assert!(error.to_string().contains(what), "{text} {error}");
    }
}

#[test]
fn hostile_files_are_refused_in_bounded_time() {
    error(&"[[allow]]\npeer = \"a\"\n".repeat(5000));
    let names = (0..30_000).map(|n| format!("\"/n{n}\"")).collect::<Vec<_>>().join(",");
    let text = format!("[[allow]]\npeer = \"a\"\nserve = [{names}]");
    assert!(error(&text).what.contains("65536 patterns"));
    error(&format!("[[allow]]\npeer = \"{}\"", "a".repeat(256)));
    error(&format!("[[allow]]\npeer = \"a\"\nsee = \"/{}\"", "a".repeat(1024)));
    error("[[allow]]\npeer = \"a\"\nsee = \"/\u{0}");
}

#[test]
fn hostile_names_are_judged_as_they_are_written() {
    let rules =
        rules("default = \"deny\"\n[[allow]]\npeer = \"a\"\npublish = [\"/robot/*/x\", \"/ä/**\"]");
    let may = |name: &str| rules.check(Principal::Name("a"), Verb::Publish, name).allowed();
    assert!(may("/robot/arm/x") && may("/ä") && may("/ä/b/c"));
    // The decomposed form of the same letter is a different name.
    assert!(!may("/a\u{308}/b"));
    for name in ["", "/", "//", "robot/arm/x", "/robot/arm/x/", "/robot/a/b/x", "/robot/arm/x\0"] {
        assert!(!may(name), "{name:?}");
    }
    assert!(!may(&format!("/robot/{}", "a/".repeat(32_768))));
    assert!(may(&format!("/robot/{}/x", "a".repeat(65_536))));
}

proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "(\\[\\[(allow|deny|limit|expect)\\]\\]|peer|see|=|\"|/|\\*|\n|[a-z]){0,40}") {
        let _ = AccessRules::parse(&text, "access.toml");
    }
}
