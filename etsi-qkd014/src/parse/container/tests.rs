use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;

const ID_1: &str = "bc490419-7d60-487f-adc1-4ddcc177c139";
const ID_2: &str = "0a782fb5-3434-48fe-aa4d-14f41d46cf92";
const KEY_1: &str = "wHHVxRwDJs3/bXd38GHP3oe4svTuRpZS0yCC7x4Ly+s=";
const KEY_2: &str = "OeGMPxh1+2RpJpNCYixWHFLYRubpOKCw94FcCI7VdJA=";

fn encode(bytes: &[u8]) -> String {
    use ::base64::Engine;
    ::base64::engine::general_purpose::STANDARD.encode(bytes)
}

fn two() -> Value {
    json!({"keys": [{"key_ID": ID_1, "key": KEY_1}, {"key_ID": ID_2, "key": KEY_2}]})
}

fn parse(answer: &Value, asked: &Asked<'_>, size: Option<u32>) -> Result<KeyContainer, Error> {
    key_container(answer.to_string().as_bytes(), asked, size, Quirks::STRICT)
}

fn refused(answer: &Value) -> Error {
    let error = parse(answer, &Asked::Number(2), Some(256)).err().expect("it must be refused");
    let shown = format!("{error} {error:?}");
    for key in [KEY_1, KEY_2] {
        assert!(!shown.contains(&key[..12]), "an error shows a key: {shown}");
    }
    error
}

fn changed(pointer: &str, to: Value) -> Value {
    let mut answer = two();
    *answer.pointer_mut(pointer).unwrap() = to;
    answer
}

#[test]
fn too_few_and_too_many_keys_are_refused() {
    for number in [0, 1, 3] {
        let error = parse(&two(), &Asked::Number(number), None).err().unwrap();
        assert!(matches!(error, Error::Check { .. }), "{error}");
    }
    assert!(matches!(refused(&changed("/keys", json!([]))), Error::Check { .. }));
}

#[test]
fn a_repeated_key_id_is_refused_in_any_letter_case() {
    for again in [ID_1.to_owned(), ID_1.to_ascii_uppercase()] {
        assert!(matches!(refused(&changed("/keys/1/key_ID", json!(again))), Error::Check { .. }));
    }
}

#[test]
fn key_ids_are_present_and_sane() {
    let long = "x".repeat(129);
    for bad in [json!(""), json!("two words"), json!("\n"), json!(long), json!(7), json!(null)] {
        let error = refused(&changed("/keys/1/key_ID", bad.clone()));
        assert!(matches!(error, Error::Malformed { .. }), "{bad}: {error}");
    }
    assert!(matches!(refused(&changed("/keys/1/key_ID", json!("key-7"))), Error::Check { .. }));
    let mut answer = two();
    answer["keys"][0].as_object_mut().unwrap().remove("key_ID");
    assert!(matches!(refused(&answer), Error::Malformed { .. }));
}

#[test]
fn an_id_that_is_no_uuid_needs_its_quirk() {
    let answer = changed("/keys/1/key_ID", json!("key-7")).to_string();
    let keys =
        key_container(answer.as_bytes(), &Asked::Number(2), Some(256), Quirks::ANY_KEY_ID).unwrap();
    assert_eq!(keys.keys[1].key_id(), "key-7");
}

#[test]
fn keys_of_another_size_are_refused() {
    assert!(matches!(refused(&changed("/keys/1/key", json!("AAAA"))), Error::Check { .. }));
    // If no size was requested, the keys must at least have the same size.
    let unequal = changed("/keys/1/key", json!("AAAA"));
    assert!(parse(&unequal, &Asked::Number(2), None).is_err());
    assert!(parse(&two(), &Asked::Number(2), Some(128)).is_err());
}

#[test]
fn a_key_that_is_no_base64_text_is_refused_without_being_shown() {
    for bad in [
        json!(&KEY_1[..43]),
        json!(format!("{KEY_1}!")),
        json!([KEY_1]),
        json!({"a": KEY_1}),
        json!(1),
        json!(""),
        json!(null),
    ] {
        refused(&changed("/keys/0/key", bad));
    }
    refused(&changed("/keys/0", json!(KEY_1)));
    refused(&changed("/keys", json!(KEY_1)));
    refused(&json!(KEY_1));
    let mut extra = two();
    extra["keys"][0][KEY_1] = json!(1);
    refused(&extra);
}

#[test]
fn members_that_come_twice_are_refused() {
    let text = format!(r#"{{"keys":[{{"key_ID":"{ID_1}","key":"{KEY_1}","key":"{KEY_2}"}}]}}"#);
    let error =
        key_container(text.as_bytes(), &Asked::Number(1), None, Quirks::STRICT).err().unwrap();
    assert!(error.to_string().contains("twice"), "{error}");
}

#[test]
fn deep_and_wide_answers_are_refused() {
    let deep = format!("{{\"keys\":{}{}}}", "[".repeat(10_000), "]".repeat(10_000));
    let wide = format!("{{\"keys\":[{}1]}}", "1,".repeat(100_000));
    let many: Vec<String> = (0..1000).map(|i| format!("\"m{i}\":1")).collect();
    let members = format!("{{{}}}", many.join(","));
    for text in [deep, wide, members] {
        let result = key_container(text.as_bytes(), &Asked::Number(1), None, Quirks::EXTRA_MEMBERS);
        assert!(matches!(result.err(), Some(Error::Malformed { .. })));
    }
}

#[test]
fn trailing_text_and_every_cut_are_refused() {
    let text = two().to_string();
    for cut in 0..text.len() {
        let result =
            key_container(&text.as_bytes()[..cut], &Asked::Number(2), None, Quirks::STRICT);
        assert!(result.is_err(), "cut at {cut}");
    }
    let more = format!("{text}{{}}");
    assert!(key_container(more.as_bytes(), &Asked::Number(2), None, Quirks::STRICT).is_err());
}

#[test]
fn dec_keys_returns_requested_keys_in_requested_order_and_spelling() {
    let asked = [ID_2.to_ascii_uppercase(), ID_1.to_owned()];
    let container = parse(&two(), &Asked::Ids(&asked), Some(256)).unwrap();
    assert_eq!(container.keys[0].key_id(), asked[0]);
    assert_eq!(container.keys[1].key_id(), asked[1]);
    assert_eq!(container.keys[0].expose_secret()[0], 0x39);
    assert_eq!(container.keys[1].expose_secret()[0], 0xc0);
}

#[test]
fn dec_keys_refuses_a_key_that_was_not_asked_for() {
    let asked = [ID_1.to_owned(), "11111111-2222-4333-8444-555555555555".to_owned()];
    assert!(matches!(parse(&two(), &Asked::Ids(&asked), None).err(), Some(Error::Check { .. })));
}

#[test]
fn extensions_are_kept_as_json() {
    let mut answer = two();
    answer["key_container_extension"] = json!({"vendor": [1]});
    answer["keys"][0]["key_extension"] = json!({"a": 1});
    answer["keys"][0]["key_ID_extension"] = json!({"b": 2});
    let container = parse(&answer, &Asked::Number(2), Some(256)).unwrap();
    assert_eq!(container.extension, Some(json!({"vendor": [1]})));
    assert_eq!(container.keys[0].extension(), Some(&json!({"a": 1})));
    assert_eq!(container.keys[0].key_id_extension(), Some(&json!({"b": 2})));
    assert_eq!(container.keys[1].extension(), None);
}

#[test]
fn extensions_are_objects_but_by_their_quirk() {
    let key_extensions = ["/keys/0/key_ID_extension", "/keys/1/key_extension"];
    for odd in [json!([1]), json!("abc"), json!(7)] {
        for place in key_extensions.into_iter().chain(["/key_container_extension"]) {
            let mut answer = two();
            let (object, name) = place.rsplit_once('/').unwrap();
            answer.pointer_mut(object).unwrap()[name] = odd.clone();
            let text = answer.to_string();
            let read = |quirks| key_container(text.as_bytes(), &Asked::Number(2), None, quirks);
            let refused = read(Quirks::STRICT).err().unwrap().to_string();
            assert!(refused.contains(name) && refused.contains("any-extension"), "{refused}");
            read(Quirks::ANY_EXTENSION).unwrap();
        }
    }
}

#[test]
fn a_repeated_id_is_found_among_such_as_begin_alike() {
    let mut ids: Vec<_> = (0..50).map(|n| format!("00000000-0000-0000-0000-{n:012x}")).collect();
    assert_eq!(repeated(ids.iter().map(String::as_str)), None);
    ids.push(ids[0x2b].to_ascii_uppercase());
    let found = repeated(ids.iter().map(String::as_str)).unwrap();
    assert!(found.eq_ignore_ascii_case(&ids[0x2b]), "{found}");
    // Also short IDs, of which one is a prefix of another.
    assert_eq!(repeated(["k", "key-1", "key-10", "key-100000", "key-10000"].into_iter()), None);
    assert_eq!(repeated(["k", "key-1", "K"].into_iter()), Some("k"));
}

#[test]
fn keys_compare_by_their_secret_alone() {
    let same = changed("/keys/1/key", json!(KEY_1));
    let container = parse(&same, &Asked::Number(2), Some(256)).unwrap();
    assert!(container.keys[0] == container.keys[1]);
    let other = parse(&two(), &Asked::Number(2), Some(256)).unwrap();
    assert!(other.keys[0] != other.keys[1]);
    assert_eq!(other.keys[0].expose_array::<32>().map(|k| k[0]), Some(0xc0));
    assert!(other.keys[0].expose_array::<16>().is_none());
}

#[test]
fn no_answer_is_shorter_than_its_least_length() {
    for number in 1..4 {
        for bytes in [1, 2, 3, 4, 32, 100] {
            let key = encode(&vec![0; bytes]);
            let item = format!(r#"{{"key_ID":"x","key":"{key}"}}"#);
            let shortest = format!(r#"{{"keys":[{}]}}"#, vec![item; number].join(","));
            let least = least_length(number, Some(bytes as u32 * 8));
            assert_eq!(least, shortest.len() as u64, "{shortest}");
            assert!(least_length(number, None) <= least);
        }
    }
}

/// Returns a key_ID, and the same number as its key.
fn numbered(number: u8, upper: bool) -> (String, Value) {
    let id = format!("{number:02x}490419-7d60-487f-adc1-4ddcc177c139");
    let shown = if upper { id.to_ascii_uppercase() } else { id.clone() };
    (id, json!({"key_ID": shown, "key": encode(&[number; 4])}))
}

proptest! {
    #[test]
    fn keys_in_any_order_and_letter_case_come_back_as_asked(
        order in Just((0..40_u8).map(|n| n.wrapping_mul(37)).collect::<Vec<_>>()).prop_shuffle(),
        upper: [bool; 40],
    ) {
        let mut sorted = order.clone();
        sorted.sort_unstable();
        let ids: Vec<String> = sorted.iter().map(|n| numbered(*n, false).0).collect();
        let came: Vec<Value> = order.iter().zip(upper).map(|(n, up)| numbered(*n, up).1).collect();
        let container = parse(&json!({ "keys": came }), &Asked::Ids(&ids), Some(32)).unwrap();
        for ((key, id), number) in container.keys.iter().zip(&ids).zip(&sorted) {
            prop_assert_eq!(key.key_id(), id);
            prop_assert_eq!(key.expose_secret(), &[*number; 4]);
        }
        // One key replaces another.
        let mut other = came;
        other[7]["key_ID"] = json!(ID_2);
        let strange = parse(&json!({ "keys": other }), &Asked::Ids(&ids), Some(32));
        prop_assert!(strange.is_err());
        let again = other[8]["key_ID"].clone();
        other[7]["key_ID"] = again;
        let repeated = parse(&json!({ "keys": other }), &Asked::Ids(&ids), Some(32));
        prop_assert!(repeated.is_err());
    }

    #[test]
    fn any_bytes_are_parsed_without_panic(bytes: Vec<u8>) {
        let _ = key_container(&bytes, &Asked::Number(1), None, Quirks::STRICT);
    }

    #[test]
    fn a_damaged_answer_is_parsed_without_panic(at in 0..200_usize, byte: u8) {
        let mut text = two().to_string().into_bytes();
        let at = at % text.len();
        text[at] = byte;
        let _ = key_container(&text, &Asked::Number(2), Some(256), Quirks::STRICT);
    }
}
