//! Expressions for names of DDS, against the C library's `fnmatch`, which they are defined by.
#![allow(unsafe_code)]

use std::ffi::CString;

use axon_transport::internal::sros2::Expression;

/// Returns all texts of these characters up to this length.
fn texts(characters: &str, longest: usize) -> Vec<String> {
    let mut all = vec![String::new()];
    let mut last = all.clone();
    for _ in 0..longest {
        let longer =
            |text: &String| characters.chars().map(|c| format!("{text}{c}")).collect::<Vec<_>>();
        last = last.iter().flat_map(longer).collect();
        all.extend(last.iter().cloned());
    }
    all
}

fn fnmatch(pattern: &CString, name: &CString) -> bool {
    // SAFETY: both are strings that end with a 0 byte.
    unsafe { libc::fnmatch(pattern.as_ptr(), name.as_ptr(), 0) == 0 }
}

fn compare(patterns: impl IntoIterator<Item = String>, names: &[String]) -> usize {
    let names: Vec<_> =
        names.iter().map(|name| (name, CString::new(name.as_str()).unwrap())).collect();
    let mut compared = 0;
    for pattern in patterns {
        let Ok(expression) = Expression::new(&pattern) else { continue };
        let of_c = CString::new(pattern.as_str()).unwrap();
        for (name, of_name) in &names {
            assert_eq!(expression.fits(name), fnmatch(&of_c, of_name), "{pattern:?} {name:?}");
            compared += 1;
        }
    }
    compared
}

#[test]
fn short_expressions_match_like_fnmatch() {
    let names = texts("ab/]-", 3);
    assert!(compare(texts("*?[]!a-\\/", 4), &names) > 500_000);
}

#[test]
fn bracket_sets_match_like_fnmatch() {
    let names = texts("ab/]-^![\\:", 2);
    let sets = texts("]!^a-b\\[", 4).into_iter().map(|inner| format!("[{inner}]"));
    assert!(compare(sets, &names) > 100_000);
    let all: Vec<_> = (1..128u8).map(|byte| char::from(byte).to_string()).collect();
    let classes = [
        "alnum", "alpha", "blank", "cntrl", "digit", "graph", "lower", "print", "punct", "space",
        "upper", "xdigit",
    ];
    let classes = classes.into_iter().flat_map(|class| {
        ["[[:CLASS:]]", "[![:CLASS:]_]", "[a[:CLASS:]-]"].map(|form| form.replace("CLASS", class))
    });
    assert_eq!(compare(classes, &all), 36 * 127);
}
