//! The JSON that Python writes.

use serde_json::Value;

/// Starts a text that stands for a number; no name or text of a store starts with it.
const NUMBER: char = '\0';

/// Parses JSON in which `NaN`, `Infinity` and `-Infinity` may stand for numbers, as Python writes them. Numbers that are not whole
/// become texts for [`number`]: `serde_json` would round some of them otherwise than NumPy.
///
/// # Errors
/// What is wrong with it.
pub fn parse(bytes: &[u8]) -> Result<Value, String> {
    let text = std::str::from_utf8(bytes).map_err(|e| e.to_string())?;
    let mut out = String::with_capacity(text.len() + text.len() / 8);
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let length = match first {
            '"' => quoted(rest),
            '-' | '+' | '.' | '0'..='9' | 'A'..='Z' | 'a'..='z' => {
                rest.find(|c: char| !(c.is_ascii_alphanumeric() || "+-.".contains(c))).unwrap_or(rest.len())
            }
            _ => first.len_utf8(),
        };
        let (token, after) = rest.split_at(length);
        let whole = token.parse::<i64>().is_ok() || token.parse::<u64>().is_ok();
        if !whole && length > 0 && token.parse::<f64>().is_ok() {
            out.extend(["\"\\u0000", token, "\""]);
        } else {
            out.push_str(token);
        }
        rest = after;
    }
    serde_json::from_str(&out).map_err(|e| e.to_string())
}

/// Length of the text in quotes that `rest` starts with.
fn quoted(rest: &str) -> usize {
    let mut escaped = false;
    for (at, c) in rest.char_indices().skip(1) {
        match c {
            '"' if !escaped => return at + 1,
            '\\' => escaped = !escaped,
            _ => escaped = false,
        }
    }
    rest.len()
}

/// The number that a value is, and whether it is whole.
pub fn number(value: &Value) -> Option<(f64, bool)> {
    match value {
        Value::Number(number) => number.as_f64().map(|v| (v, true)),
        Value::String(text) => text.strip_prefix(NUMBER)?.parse().ok().map(|v| (v, false)),
        _ => None,
    }
}

/// The text that a value is.
pub fn text(value: &Value) -> Option<&str> {
    value.as_str().filter(|text| !text.starts_with(NUMBER))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn python_writes_numbers_that_json_has_not() {
        let value = parse(
            br#"{"a": NaN, "b": -Infinity, "c": [1, 2.5e-3, -7], "d": "NaN, 1.5 \" 2.5", "e": true, "f": null, "g": 18446744073709551615}"#,
        );
        let value = value.unwrap();
        assert!(number(&value["a"]).is_some_and(|(v, whole)| v.is_nan() && !whole));
        assert_eq!(number(&value["b"]), Some((f64::NEG_INFINITY, false)));
        assert_eq!(
            value["c"].as_array().unwrap().iter().map(number).collect::<Vec<_>>(),
            [Some((1.0, true)), Some((0.0025, false)), Some((-7.0, true))]
        );
        assert_eq!((text(&value["d"]), text(&value["a"])), (Some("NaN, 1.5 \" 2.5"), None));
        assert_eq!((value["e"].as_bool(), value["f"].is_null(), number(&value["g"])), (Some(true), true, Some((u64::MAX as f64, true))));
    }

    #[test]
    fn numbers_are_read_exactly() {
        // serde_json alone is one unit in the last place off in some of them.
        for i in 1..2000u32 {
            let exact = f64::from(i).sqrt() * 10f64.powi(i as i32 % 60 - 30);
            assert_eq!(number(&parse(format!("{exact:?}").as_bytes()).unwrap()), Some((exact, false)));
        }
    }

    #[test]
    fn what_is_no_json_is_refused() {
        for wrong in ["", "{", "[1,", "\"abc", "{\"a\": nope}", "1 2", &"[".repeat(100_000)] {
            assert!(parse(wrong.as_bytes()).is_err(), "{wrong:.20}");
        }
        assert!(parse(&[0xff]).is_err());
    }
}
