//! Where the combat tests' data lies, and how numbers are read from it.

use serde_json::Value;
use std::{env, fs, path::PathBuf};

/// The folder named by `RIT_SMAC_DIR`, or the repository's copy.
#[allow(dead_code, reason = "not every test uses all")]
pub fn folder() -> PathBuf {
    env::var_os("RIT_SMAC_DIR")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/smac"), PathBuf::from)
}

/// A JSON file of that folder.
pub fn read(name: &str) -> Value {
    let path = folder().join(name);
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

pub fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number, not {value}"))
}

pub fn index(value: &Value) -> usize {
    value.as_u64().unwrap_or_else(|| panic!("a whole number, not {value}")) as usize
}

pub fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

pub fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_else(|| panic!("a string, not {value}"))
}
