//! The error (clause 6.5). This is the most lenient parser: the status code alone has already told
//! the result, whatever the body contains.

use serde::de::DeserializeOwned;
use serde_json::Value;

use super::json::{self, Object};
use crate::Quirks;

/// Longest message that is passed on, in bytes.
const MAX_MESSAGE: usize = 512;
/// Most details that are passed on.
const MAX_DETAILS: usize = 64;

#[derive(Debug, Default)]
pub(crate) struct ErrorAnswer {
    pub(crate) message: String,
    pub(crate) details: Vec<Value>,
}

/// Reads only the two members that the specification lists. Other members are not copied, because a
/// faulty KME may have put keys there.
pub(crate) fn error_answer(body: &[u8]) -> ErrorAnswer {
    let object = json::text(body).and_then(|text| Object::parse(text, Quirks::NULL_MEMBERS));
    let Ok(mut object) = object else { return ErrorAnswer::default() };
    let message = member(&mut object, "message").map(|message: String| printable(&message));
    let mut details: Vec<Value> = member(&mut object, "details").unwrap_or_default();
    details.truncate(MAX_DETAILS);
    ErrorAnswer { message: message.unwrap_or_default(), details }
}

fn member<T: DeserializeOwned>(object: &mut Object<'_>, name: &str) -> Option<T> {
    let raw = object.take(name).ok()??;
    json::is_shallow(raw).then(|| serde_json::from_str(raw).ok())?
}

/// Makes a message safe for logs and terminals: limits its length, and removes characters that move
/// the cursor, begin a line or change the direction of writing.
fn printable(message: &str) -> String {
    let mut out = String::new();
    for c in message.chars() {
        if out.len() + c.len_utf8() > MAX_MESSAGE {
            out.push('…');
            break;
        }
        out.push(if is_layout(c) { ' ' } else { c });
    }
    out
}

fn is_layout(c: char) -> bool {
    // The standard library knows which characters are printable; it also escapes quotes, which are
    // kept here.
    !matches!(c, '"' | '\'' | '\\') && c.escape_debug().len() > 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn bodies_that_are_no_error_objects_give_an_empty_message() {
        for body in ["", "<html>", "[]", "\"x\"", "{\"message\":1,\"details\":{}}", "{"] {
            let answer = error_answer(body.as_bytes());
            assert_eq!((answer.message.as_str(), answer.details.len()), ("", 0), "{body}");
        }
    }

    #[test]
    fn messages_are_made_fit_for_a_terminal() {
        let answer = error_answer(br#"{"message":"no\u001b[2J key\n"}"#);
        assert_eq!(answer.message, "no [2J key ");
        let turned = error_answer("{\"message\":\"a\u{202e}b\u{2028}c\u{61c}\"}".as_bytes());
        assert_eq!(turned.message, "a b c ");
        let long = format!("{{\"message\":\"{}\"}}", "x".repeat(10_000));
        assert!(error_answer(long.as_bytes()).message.len() < 600);
    }

    #[test]
    fn details_are_kept() {
        let answer = error_answer(br#"{"message":"m","details":[{"key_ID":"k"}]}"#);
        assert_eq!(answer.details, [serde_json::json!({"key_ID": "k"})]);
    }

    proptest! {
        #[test]
        fn any_bytes_are_parsed_without_panic(bytes: Vec<u8>) {
            let _ = error_answer(&bytes);
        }
    }
}
