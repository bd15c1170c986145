//! What the columns of a task set's observations and its actions are called, for people and for weights files.

use crate::{TaskSet, combat::CombatSet};

impl TaskSet {
    /// Features of an entity, by column, without its last action's one-hot.
    pub fn feature_names(self) -> Vec<String> {
        match self {
            Self::MatrixGame => named(&["player.0", "player.1", "step"]),
            Self::CooperativeNavigation | Self::PredatorPrey | Self::PredatorPreyPro => {
                named(&["x", "y", "velocity.x", "velocity.y", "kind.agent", "kind.landmark", "kind.prey"])
            }
            Self::Combat(set) => combat_features(set),
            Self::Foreign(set) => set.feature_names.clone(),
        }
    }

    /// Actions, by number.
    pub fn action_names(self) -> Vec<String> {
        match self {
            Self::MatrixGame => named(&["a1", "a2", "a3"]),
            Self::CooperativeNavigation | Self::PredatorPrey | Self::PredatorPreyPro => {
                named(&["none", "left", "right", "down", "up"])
            }
            Self::Combat(set) => combat_actions(set),
            Self::Foreign(set) => set.action_names.clone(),
        }
    }
}

fn combat_features(set: CombatSet) -> Vec<String> {
    let mut names: Vec<String> = (0..16).map(|tag| format!("tag.{tag}")).collect();
    // An agent's own available actions; those of the dead and of standing still are no features.
    names.extend(combat_actions(set).iter().skip(2).map(|action| format!("available.{action}")));
    names.extend(set.one_hot().iter().map(|kind| format!("type.{}", format!("{kind:?}").to_lowercase())));
    names.push("health".to_owned());
    if set.has_shields() {
        names.push("shield".to_owned());
    }
    names.extend(named(&["energy", "weapon_cooldown", "x", "y", "x_from_middle", "y_from_middle"]));
    names
}

fn combat_actions(set: CombatSet) -> Vec<String> {
    let mut names = named(&["no_op", "stop", "north", "south", "east", "west"]);
    let targets = set.n_actions() - names.len();
    names.extend((0..targets).map(|tag| format!("target.{tag}")));
    names
}

fn named(names: &[&str]) -> Vec<String> {
    names.iter().map(|&name| name.to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{EnvironmentOptions, Split};
    use rit_episode::{Observation, RunSeed, Stream};
    use std::collections::HashSet;

    #[test]
    fn every_column_and_every_action_has_a_name_of_its_own() {
        for set in TaskSet::ALL {
            let spec = set.tasks(Split::Training)[0].spec();
            let (features, actions) = (set.feature_names(), set.action_names());
            assert_eq!((features.len(), actions.len()), (spec.feature_dim, spec.n_actions), "{set}");
            for names in [features, actions] {
                assert_eq!(names.iter().collect::<HashSet<_>>().len(), names.len(), "{set}");
            }
        }
    }

    /// A battle's first state, read by name: each ally may do what its features say, has its type and its health.
    #[test]
    fn combat_names_are_those_of_their_columns() {
        for set in TaskSet::ALL.into_iter().filter(|set| matches!(set, TaskSet::Combat(_))) {
            let task = set.tasks(Split::Training)[0];
            let (spec, features, actions) = (task.spec(), set.feature_names(), set.action_names());
            let mut world = task.environment(EnvironmentOptions::default());
            world.reset(&mut RunSeed(1).stream(Stream::Environment, 0)).unwrap();
            let mut seen = Observation::new(spec.n_agents, spec.n_entities, spec.feature_dim, spec.n_actions);
            world.observe(&mut seen);
            for (agent, entity) in seen.entities().chunks_exact(spec.feature_dim).enumerate() {
                let value = |name: &str| entity[features.iter().position(|known| known == name).unwrap()];
                assert_eq!(value("health"), 1.0);
                let sum = |prefix: &str| -> f32 {
                    features.iter().filter(|name| name.starts_with(prefix)).map(|name| value(name)).sum()
                };
                assert!(sum("type.") <= 1.0 && sum("tag.") == 1.0);
                for (action, name) in actions.iter().enumerate().skip(2).filter(|_| agent < spec.n_agents) {
                    let available = f32::from(seen.available_to(agent)[action]);
                    assert_eq!(value(&format!("available.{name}")), available, "{set} {name}");
                }
            }
        }
    }
}
