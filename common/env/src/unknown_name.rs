//! Names that a person types, and the answer when one means nothing.

use std::fmt;

/// A name that means nothing, with those that do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown {what} {name:?}; known: {}", known.join(", "))]
pub struct UnknownName {
    /// What was asked for.
    pub what: &'static str,
    /// The name given.
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
            name: name.to_owned(),
            known: known.iter().map(T::to_string).collect(),
        })
    }
}
