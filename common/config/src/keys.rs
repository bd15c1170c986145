//! The keys there are: what kind of value each takes, and which one a misspelt name may mean.

use crate::{
    ConfigError,
    number::{CountError, WHOLE_MAX, count},
};
use toml::{Table, Value};

/// Longest key that is compared with the known ones: comparing takes time in proportion to the length.
const COMPARED_LEN_MAX: usize = 100;

/// Characters of a typed text that a message shows.
const SHOWN_LEN_MAX: usize = 60;

/// How alike a key must be to be suggested, from 0 to 1.
const ALIKE: f64 = 0.8;

/// Every typed key must be one of the defaults', and of its kind. `listed` are those that a message may list.
pub fn check(typed: &Table, defaults: &Table, listed: &Table) -> Result<(), ConfigError> {
    check_section(typed, defaults, "", &|key| unknown(key, defaults, listed))
}

fn check_section(
    typed: &Table,
    section: &Table,
    prefix: &str,
    unknown: &dyn Fn(&str) -> ConfigError,
) -> Result<(), ConfigError> {
    for (name, value) in typed {
        let key = format!("{prefix}{name}");
        let default = section.get(name).ok_or_else(|| unknown(&key))?;
        let wrong =
            |found: String| ConfigError::Kind { key: key.clone(), expected: expected(default), found };
        match (value, default) {
            (Value::Table(value), Value::Table(default)) => {
                check_section(value, default, &format!("{key}."), unknown)?;
            }
            // A whole number will do for a real one.
            (Value::Integer(_), Value::Float(_)) => {}
            (Value::Integer(number), Value::Integer(_)) if *number < 0 => {
                return Err(wrong(number.to_string()));
            }
            (Value::Float(number), Value::Integer(_)) if number.fract() == 0.0 && number.abs() < 1e15 => {
                return Err(wrong(format!("{number:?}; write {number:.0}")));
            }
            _ if value.same_type(default) => {}
            _ => return Err(wrong(found(value))),
        }
    }
    Ok(())
}

/// What `--set key=text` sets, as the key's kind reads the text. `listed` are the keys that a message may list.
///
/// # Errors
/// When there is no such key, or the text is of another kind.
pub fn read(key: &str, text: &str, defaults: &Table, listed: &Table) -> Result<Value, ConfigError> {
    let former = former(key);
    let default = find(key, defaults).or(former.as_ref()).ok_or_else(|| unknown(key, defaults, listed))?;
    let wrong = |found: String| {
        let key = key.to_owned();
        Err(ConfigError::Kind { key, expected: expected(default), found })
    };
    match default {
        // Quotes that the shell has left are not meant.
        Value::String(_) => Ok(Value::String(unquoted(text).unwrap_or_else(|| text.to_owned()))),
        Value::Integer(_) => match count(text) {
            Ok(number) => Ok(Value::Integer(number as i64)),
            Err(CountError::TooLarge) => Err(ConfigError::Range {
                key: key.to_owned(),
                value: text.to_owned(),
                min: "0".to_owned(),
                max: WHOLE_MAX.to_string(),
            }),
            Err(CountError::Fraction(Some(whole))) => wrong(format!("{text}; write {whole}")),
            Err(CountError::Negative | CountError::Fraction(None)) => wrong(text.to_owned()),
            Err(CountError::NoNumber) => wrong(quoted(text)),
        },
        Value::Float(_) => {
            let number = text.replace('_', "").parse().ok().or_else(|| Some(count(text).ok()? as f64));
            number.map_or_else(|| wrong(quoted(text)), |number| Ok(Value::Float(number)))
        }
        Value::Boolean(_) => {
            text.parse().map_or_else(|_| wrong(quoted(text)), |value| Ok(Value::Boolean(value)))
        }
        Value::Table(section) => {
            let example = section.keys().next().map_or_else(String::new, |name| format!("{key}.{name}"));
            wrong(format!("a value: set one of its keys, such as {example}"))
        }
        Value::Array(_) => list(text).map_or_else(|| wrong(quoted(text)), |list| Ok(Value::Array(list))),
        Value::Datetime(_) => wrong(quoted(text)),
    }
}

/// Keys that there were, and that are understood still, with a value of their kind.
fn former(key: &str) -> Option<Value> {
    match key {
        "algorithm.mixing" => Some(Value::from("network")),
        "algorithm.task_representations" => Some(Value::from(true)),
        "algorithm.time_limit_bootstraps" => Some(Value::from(false)),
        _ => None,
    }
}

/// A list as TOML has it, or words with commas between them.
fn list(text: &str) -> Option<Vec<Value>> {
    if text.starts_with('[') {
        return match value(text)? {
            Value::Array(list) => Some(list),
            _ => None,
        };
    }
    let words = text.split(',').map(str::trim).filter(|word| !word.is_empty());
    Some(words.map(Value::from).collect())
}

/// Its default, or its section's.
fn find<'a>(key: &str, defaults: &'a Table) -> Option<&'a Value> {
    let mut names = key.split('.');
    let first = defaults.get(names.next()?)?;
    names.try_fold(first, |section, name| section.as_table()?.get(name))
}

fn unquoted(text: &str) -> Option<String> {
    if !text.starts_with(['"', '\'']) {
        return None;
    }
    match value(text)? {
        Value::String(text) => Some(text),
        _ => None,
    }
}

/// The one TOML value that the text is.
fn value(text: &str) -> Option<Value> {
    let mut table: Table = format!("value = {text}").parse().ok()?;
    let value = table.remove("value")?;
    table.is_empty().then_some(value)
}

fn expected(default: &Value) -> &'static str {
    match default {
        Value::String(_) => "a text in quotes",
        Value::Integer(_) => "a whole number of at least 0",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::Table(_) => "a section",
    }
}

fn found(value: &Value) -> String {
    match value {
        Value::String(text) => quoted(text),
        Value::Integer(number) => number.to_string(),
        Value::Float(number) => format!("{number:?}"),
        Value::Boolean(value) => value.to_string(),
        Value::Datetime(date) => format!("the date {date}"),
        Value::Array(_) => "a list".to_owned(),
        Value::Table(_) => "a section".to_owned(),
    }
}

/// A typed text as a message shows it: in quotes, on one line, and not endless.
pub fn quoted(text: &str) -> String {
    let shown: String = text.chars().take(SHOWN_LEN_MAX).collect();
    format!("{shown:?}{}", if shown.len() < text.len() { "…" } else { "" })
}

fn unknown(key: &str, defaults: &Table, listed: &Table) -> ConfigError {
    let advice = closest(key, defaults).map(|known| format!("did you mean {known}?"));
    let advice = advice.unwrap_or_else(|| match key.split_once('.') {
        Some((section, _)) if matches!(defaults.get(section), Some(Value::Table(_))) => {
            format!("[{section}] has {}", names(listed, section))
        }
        _ => {
            let sections: Vec<_> = defaults.keys().map(String::as_str).collect();
            format!("a key is one of {}, and a name in it", sections.join(", "))
        }
    });
    ConfigError::UnknownKey { key: quoted(key), advice }
}

fn names(defaults: &Table, section: &str) -> String {
    let keys = defaults.get(section).and_then(Value::as_table).into_iter().flat_map(Table::keys);
    keys.map(String::as_str).collect::<Vec<_>>().join(", ")
}

/// Every key that takes a value, with its section.
pub fn all(defaults: &Table, prefix: &str) -> Vec<String> {
    let mut keys = Vec::new();
    for (name, value) in defaults {
        let key = format!("{prefix}{name}");
        match value {
            Value::Table(section) => keys.extend(all(section, &format!("{key}."))),
            _ => keys.push(key),
        }
    }
    keys
}

/// The keys of this name, in whatever section.
pub fn called(name: &str, defaults: &Table) -> Vec<String> {
    let is_called = |key: &String| key.rsplit('.').next() == Some(name);
    all(defaults, "").into_iter().filter(is_called).collect()
}

/// The known key that this one is most like, if it is like any. Names are compared and not sections: a key in the
/// wrong section is a common slip, and that a section is right says nothing of the name in it.
pub fn closest(key: &str, defaults: &Table) -> Option<String> {
    if key.len() > COMPARED_LEN_MAX {
        return None;
    }
    let last = |key: &str| key.rsplit('.').next().map(str::to_owned).unwrap_or_default();
    let section = |key: &str| key.rsplit_once('.').map(|(section, _)| section.to_owned());
    let (name, typed_section) = (last(key), section(key));
    let likeness = |known: &String| {
        // Of two equally alike, the one in the section that was typed.
        let same_section = if section(known) == typed_section { 1e-3 } else { 0.0 };
        strsim::jaro_winkler(&name, &last(known)) + same_section
    };
    let best = all(defaults, "").into_iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
    (likeness(&best) > ALIKE).then_some(best)
}
