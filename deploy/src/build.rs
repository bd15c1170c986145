//! Which build this is.

use rit_record::Build;

/// This program, for records of what it trains.
pub fn this() -> Build {
    Build::this(option_env!("RIT_COMMIT").filter(|commit| !commit.is_empty()))
}
