//! The padded sizes that every episode of a run shares.

use serde::{Deserialize, Serialize};

/// Padded sizes of a run: the largest over all tasks of its task set (paper, appendix A).
///
/// The symbols of the specification: `d`, `A`, `n`, `m`, `T`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dims {
    /// d: features of one entity, its last action's one-hot included.
    pub entity_dim: usize,
    /// A: size of the shared local action space.
    pub n_actions: usize,
    /// n: most agents in any task.
    pub agents_max: usize,
    /// m: padded entity rows: `agents_max` plus the most non-agents in any task.
    pub entities_max: usize,
    /// T: most decision steps in any episode.
    pub steps_max: usize,
}

/// Dims no episode could have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} = {value} is out of range {min}..={max}")]
pub struct DimsError {
    /// The field's name.
    pub name: &'static str,
    /// What it was.
    pub value: usize,
    /// Its smallest allowed value.
    pub min: usize,
    /// Its largest allowed value.
    pub max: usize,
}

impl Dims {
    /// Largest number of actions: an action is one byte on the wire, and the start token needs a number too.
    pub const ACTIONS_LIMIT: usize = 255;
    /// Largest number of entities: a place in the decision order is one byte on the wire.
    pub const ENTITIES_LIMIT: usize = 255;
    /// Largest number of decision steps.
    pub const STEPS_LIMIT: usize = 65_535;
    /// Largest number of features.
    pub const FEATURES_LIMIT: usize = 65_535;

    /// Checks every size against its limit.
    ///
    /// # Errors
    /// The first field that is out of range.
    pub fn validate(&self) -> Result<(), DimsError> {
        let within = |name, value, min, max| {
            if (min..=max).contains(&value) { Ok(()) } else { Err(DimsError { name, value, min, max }) }
        };
        within("entity_dim", self.entity_dim, self.n_actions + 1, Self::FEATURES_LIMIT)?;
        within("n_actions", self.n_actions, 1, Self::ACTIONS_LIMIT)?;
        within("agents_max", self.agents_max, 1, Self::ENTITIES_LIMIT)?;
        within("entities_max", self.entities_max, self.agents_max, Self::ENTITIES_LIMIT)?;
        within("steps_max", self.steps_max, 1, Self::STEPS_LIMIT)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_the_field_that_is_out_of_range() {
        let good = Dims { entity_dim: 6, n_actions: 3, agents_max: 2, entities_max: 2, steps_max: 2 };
        assert_eq!(good.validate(), Ok(()));
        let fewer_entities_than_agents = Dims { entities_max: 1, ..good };
        assert_eq!(fewer_entities_than_agents.validate().unwrap_err().name, "entities_max");
        assert_eq!(Dims { steps_max: 0, ..good }.validate().unwrap_err().name, "steps_max");
        assert_eq!(Dims { entity_dim: 3, ..good }.validate().unwrap_err().name, "entity_dim");
    }
}
