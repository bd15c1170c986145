//! Names that a person types, and the answer when one means nothing.

use std::fmt;

/// Characters of a name that are repeated: it may come from a stranger.
const NAME_CHARS: usize = 64;

/// A name that means nothing, with those that do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown {what} {name:?}; known: {}", known.join(", "))]
pub struct UnknownName {
    /// What was asked for.
    pub what: &'static str,
    /// The name given, or how it begins.
    pub name: String,
    /// Names that would do.
    pub known: Vec<String>,
}

impl UnknownName {
    /// The one of these that is displayed as `name`.
    pub(crate) fn look_up<T: Copy + fmt::Display>(
        what: &'static str,
        name: &str,
        known: &[T],
    ) -> Result<T, Self> {
        let found = known.iter().find(|one| one.to_string() == name);
        found.copied().ok_or_else(|| Self {
            what,
            name: name.chars().take(NAME_CHARS).collect(),
            known: known.iter().map(T::to_string).collect(),
        })
    }
}
