//! Weights of one run as the beginning of another: other teams, tasks, rewards and settings, of the same sizes.

use crate::{TaskNames, Weights};
use rit_algo::Model;
use std::collections::{BTreeMap, BTreeSet};

/// What another run's weights became the beginning of. Groups are what stands before the first dot of parameters' names.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CarriedOver {
    /// Groups of parameters that begin with the other run's values.
    pub reused: Vec<String>,
    /// Groups that only this model has: they begin as ever.
    pub fresh: Vec<String>,
    /// Groups that only the other model has.
    pub left: Vec<String>,
    /// Features or actions that are called otherwise, in words.
    pub renamed: Vec<String>,
}

/// Why a model cannot begin with these weights.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CarryOverError {
    /// Another size.
    #[error(
        "{name} is {theirs} in the weights and {ours} in this run; a run begins with weights of its own sizes"
    )]
    Size {
        /// Its name.
        name: String,
        /// Of the weights.
        theirs: usize,
        /// Of the run.
        ours: usize,
    },
    /// Another encoder: its parameters may have the same shapes and would mean something else.
    #[error("the weights are of {} with encoder {theirs:?}, this run is of {} with encoder {ours:?}", methods[0], methods[1])]
    Encoder {
        /// The methods, the weights' own first.
        methods: [String; 2],
        /// Of the weights.
        theirs: String,
        /// Of the run.
        ours: String,
    },
    /// Another shape under the same name.
    #[error("{name} is {theirs:?} in the weights and {ours:?} in this run")]
    Shape {
        /// The parameter.
        name: String,
        /// Of the weights.
        theirs: Vec<usize>,
        /// Of the run.
        ours: Vec<usize>,
    },
    /// Nothing in common.
    #[error("{} and {} have no parameters in common", methods[0], methods[1])]
    NothingShared {
        /// The methods, the weights' own first.
        methods: [String; 2],
    },
}

/// Writes the weights into the parameters of a model that has the same sizes. Parameters that the weights lack stay as
/// they are.
///
/// # Errors
/// When a size differs, or nothing is shared: then nothing is written.
pub fn carry_over(
    from: &Weights,
    model: &Model,
    names: &TaskNames,
    params: &mut [f32],
) -> Result<CarriedOver, CarryOverError> {
    let (theirs, ours) = (from.model.config(), model.config());
    let methods = [theirs, ours].map(|config| config.method.to_string());
    let our_sizes: BTreeMap<_, _> = ours.sizes().into_iter().collect();
    let features = |model: &rit_algo::ModelConfig| model.entity_dim - model.n_actions;
    let mut sizes = vec![
        ("the number of actions", theirs.n_actions, ours.n_actions),
        ("the number of features", features(theirs), features(ours)),
    ];
    sizes.extend(
        theirs.sizes().into_iter().filter_map(|(name, size)| Some((name, size, *our_sizes.get(name)?))),
    );
    if let Some((name, theirs, ours)) = sizes.into_iter().find(|(_, theirs, ours)| theirs != ours) {
        return Err(CarryOverError::Size { name: name.to_owned(), theirs, ours });
    }
    if theirs.encoder != ours.encoder {
        let [theirs, ours] = [theirs, ours].map(|config| config.encoder.name().to_owned());
        return Err(CarryOverError::Encoder { methods, theirs, ours });
    }
    let known: BTreeMap<&str, _> =
        from.model.layout().params().iter().map(|param| (param.name.as_str(), param)).collect();
    let (mut reused, mut fresh) = (BTreeSet::new(), BTreeSet::new());
    let mut copies = Vec::new();
    for param in model.layout().params() {
        match known.get(param.name.as_str()) {
            Some(theirs) if theirs.shape == param.shape => {
                reused.insert(group(&param.name));
                copies.push((theirs.range.clone(), param.range.clone()));
            }
            Some(theirs) => {
                let (name, ours) = (param.name.clone(), param.shape.clone());
                return Err(CarryOverError::Shape { name, theirs: theirs.shape.clone(), ours });
            }
            None => drop(fresh.insert(group(&param.name))),
        }
    }
    if copies.is_empty() {
        return Err(CarryOverError::NothingShared { methods });
    }
    for (theirs, ours) in copies {
        params[ours].copy_from_slice(&from.params[theirs]);
    }
    let left = known.keys().map(|name| group(name)).filter(|group| !reused.contains(group)).collect();
    let named = |groups: BTreeSet<String>| groups.into_iter().collect();
    Ok(CarriedOver {
        renamed: renamed(&from.description.names(), names),
        reused: named(reused),
        fresh: named(fresh),
        left: named(left),
    })
}

/// What stands before the first dot.
fn group(name: &str) -> String {
    name.split('.').next().unwrap_or_default().to_owned()
}

fn renamed(theirs: &TaskNames, ours: &TaskNames) -> Vec<String> {
    let mut renamed = Vec::new();
    for (what, theirs, ours) in
        [("feature", &theirs.features, &ours.features), ("action", &theirs.actions, &ours.actions)]
    {
        let differing = theirs.iter().zip(ours).enumerate().filter(|(_, (theirs, ours))| theirs != ours);
        renamed
            .extend(differing.map(|(at, (theirs, ours))| format!("{what} {at} was {theirs} and is {ours}")));
    }
    renamed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights_file::{Weights, encode};
    use rit_episode::{RunSeed, Stream};
    use std::fs;

    /// A run's initial weights as a file has them.
    fn weights(task_set: &str, settings: &[&str]) -> (Weights, TaskNames) {
        let settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        let text = format!("environment.task_set = {task_set:?}");
        let config = rit_config::resolve(&text, "test", &settings).unwrap();
        let (model, names) = (Model::new(config.model()).unwrap(), TaskNames::of(&config));
        let params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), encode(&model, &names, &params).unwrap()).unwrap();
        (Weights::load(file.path()).unwrap(), names)
    }

    fn carried(from: &Weights, to: &(Weights, TaskNames)) -> Result<(CarriedOver, Vec<f32>), String> {
        let (to, names) = to;
        let mut params = to.model.initial(&mut RunSeed(7).stream(Stream::Weights, 0));
        let before = params.clone();
        match carry_over(from, &to.model, names, &mut params) {
            Ok(carried) => Ok((carried, params)),
            Err(error) => {
                assert_eq!(params, before, "nothing is written");
                Err(error.to_string())
            }
        }
    }

    #[test]
    fn the_same_sizes_are_carried_over_whatever_the_tasks() {
        let (from, _) = weights("cooperative-navigation", &[]);
        let to = weights("predator-prey", &["environment.training_tasks=[\"predator-prey-6-3\"]"]);
        let (carried, params) = carried(&from, &to).unwrap();
        assert_eq!(params, from.params);
        assert_eq!(carried.reused, ["discriminator", "mixer", "task_encoder", "utility"]);
        assert_eq!((carried.fresh, carried.left, carried.renamed), (vec![], vec![], vec![]));
    }

    #[test]
    fn what_only_one_of_them_has_is_told() {
        let (from, _) = weights("cooperative-navigation", &["algorithm.name=rit-vdn"]);
        let to = weights("cooperative-navigation", &[]);
        let (there, params) = carried(&from, &to).unwrap();
        assert_eq!((there.fresh.as_slice(), there.left.is_empty()), (["mixer".to_owned()].as_slice(), true));
        let acting = to.0.model.acting();
        assert_eq!(params[acting.clone()], from.params[acting]);
        let (back, _) =
            carried(&to.0, &weights("cooperative-navigation", &["algorithm.name=rit-vdn"])).unwrap();
        assert_eq!((back.fresh.is_empty(), back.left), (true, vec!["mixer".to_owned()]));
    }

    #[test]
    fn other_sizes_are_refused_with_both_named() {
        let (from, _) = weights("cooperative-navigation", &[]);
        let refused = |task_set, settings: &[&str]| carried(&from, &weights(task_set, settings)).unwrap_err();
        assert_eq!(
            refused("matrix-game", &[]),
            "the number of actions is 5 in the weights and 3 in this run; a run begins with weights of its own sizes"
        );
        assert!(
            refused("predator-prey", &["network.hidden_dim=32"])
                .starts_with("hidden_dim is 64 in the weights and 32 in this run")
        );
        assert!(
            refused("predator-prey", &["network.n_heads=2"]).starts_with("n_heads is 1 in the weights and 2")
        );
        assert_eq!(
            refused("predator-prey", &["algorithm.name=vdn-attn"]),
            "the weights are of rit with encoder \"beside\", this run is of vdn-attn with encoder \"within\""
        );
        let (flat, _) = weights("cooperative-navigation", &["algorithm.name=mappo"]);
        let larger = weights(
            "cooperative-navigation",
            &["algorithm.name=mappo", "environment.testing_tasks=[\"navigation-8-8\"]"],
        );
        assert!(
            carried(&flat, &larger)
                .unwrap_err()
                .starts_with("agents_max is 6 in the weights and 8 in this run")
        );
        assert!(refused("cooperative-navigation", &["algorithm.name=mappo"]).contains("encoder \"flat\""));
    }
}
