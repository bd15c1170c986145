//! What follows from `algorithm.name`: which keys a method has, its preset, and what older spellings of it mean.

use crate::{ConfigError, resolve::parse};
use rit_algo::{
    Method, Regime,
    method::{Encoder, Facts, Mixing},
};
use rit_env::TaskSet;
use toml::{Table, Value};

/// Whether a method has this key. Keys that are not named here belong to every method.
pub(crate) fn has(method: Method, key: &str) -> bool {
    let Facts { regime, encoder, task_representations, mixing, .. } = method.facts();
    let attends = encoder != Encoder::Flat;
    match key {
        "algorithm.epsilon_start"
        | "algorithm.epsilon_finish"
        | "algorithm.epsilon_anneal_steps"
        | "algorithm.exploration_persistence"
        | "algorithm.buffer_size"
        | "algorithm.batch_size"
        | "algorithm.target_update_interval"
        | "algorithm.reward_scale" => regime == Regime::Replay,
        "algorithm.epochs"
        | "algorithm.minibatches"
        | "algorithm.clip"
        | "algorithm.gae_lambda"
        | "algorithm.entropy_coef"
        | "algorithm.value_coef"
        | "algorithm.huber_delta"
        | "algorithm.value_norm_beta" => regime == Regime::OnPolicy,
        "algorithm.encoder" => encoder == Encoder::Within,
        "algorithm.imagined_weight" => method == Method::Refil,
        "algorithm.role_entropy_weight"
        | "algorithm.role_kl_weight"
        | "algorithm.role_dissimilarity_weight"
        | "algorithm.role_soft_constraint"
        | "network.role_dim"
        | "network.role_hidden_dim"
        | "network.role_variance_floor" => method == Method::Roma,
        "network.attention_dim" => attends,
        "network.n_heads" => attends || method == Method::Mat,
        "network.n_blocks" => method == Method::Mat,
        "network.task_representation_dim" | "network.reward_embed_dim" => task_representations,
        "network.mixing_embed_dim" | "network.hypernet_embed_dim" => mixing == Some(Mixing::Network),
        "network.feedforward_dim" => encoder == Encoder::Tokens,
        _ => true,
    }
}

/// The first typed key that the method has no use for.
pub(crate) fn check(typed: &Table, method: Method) -> Result<(), ConfigError> {
    for (section, value) in typed {
        for name in value.as_table().into_iter().flat_map(Table::keys) {
            let key = format!("{section}.{name}");
            if !has(method, &key) {
                let owners = Method::ALL.into_iter().filter(|&other| has(other, &key));
                let owners = owners.map(Method::name).collect::<Vec<_>>().join(", ");
                return Err(ConfigError::NotOfMethod { key, method, owners });
            }
        }
    }
    Ok(())
}

/// Takes the keys away that the method has no use for.
pub(crate) fn retain(config: &mut Table, method: Method) {
    for (section, value) in config {
        if let Value::Table(keys) = value {
            keys.retain(|name, _| has(method, &format!("{section}.{name}")));
        }
    }
}

/// The keys that a method has, of all that there are.
pub(crate) fn of_method(all: &Table, method: Method) -> Table {
    let mut own = all.clone();
    retain(&mut own, method);
    own
}

/// The method that the last of these `section.key=value` settings names that names one.
pub(crate) fn assigned(assignments: &[String]) -> Option<Method> {
    let name = |assignment: &String| {
        let (key, name) = assignment.split_once('=')?;
        (key.trim() == "algorithm.name").then(|| name.trim().trim_matches('"').parse().ok())?
    };
    assignments.iter().rev().find_map(name)
}

/// What a method sets differently from the defaults and the task set's preset. At the top for all task sets, and in
/// sections of a family's name for its task sets. Most methods need none: the paper's settings are one table for all.
fn preset(method: Method) -> &'static str {
    match method {
        Method::Mappo => include_str!("presets/methods/mappo.toml"),
        Method::Mat => include_str!("presets/methods/mat.toml"),
        _ => "",
    }
}

/// Task sets of one family share their settings.
pub const fn family(task_set: TaskSet) -> &'static str {
    match task_set {
        TaskSet::MatrixGame => "matrix",
        TaskSet::CooperativeNavigation | TaskSet::PredatorPrey | TaskSet::PredatorPreyPro => "mpe",
        TaskSet::Combat(_) => "smac",
        TaskSet::Foreign(_) => "foreign",
    }
}

/// The presets between the defaults and the experiment, the lowest first: texts, and where they are from.
pub(crate) fn presets(method: Method, task_set: TaskSet) -> Result<Vec<Table>, ConfigError> {
    let family = family(task_set);
    let of_family = match task_set {
        TaskSet::MatrixGame => include_str!("presets/matrix.toml"),
        TaskSet::CooperativeNavigation | TaskSet::PredatorPrey | TaskSet::PredatorPreyPro => {
            include_str!("presets/mpe.toml")
        }
        TaskSet::Combat(_) => include_str!("presets/smac.toml"),
        TaskSet::Foreign(_) => "",
    };
    let mut of_method = parse(preset(method), "the method's preset")?;
    let mut of_both = Table::new();
    for known in FAMILIES {
        if let Some(Value::Table(section)) = of_method.remove(known)
            && known == family
        {
            of_both = section;
        }
    }
    Ok(vec![parse(of_family, "the task set's preset")?, of_method, of_both])
}

/// Every family there are settings for.
const FAMILIES: [&str; 3] = ["matrix", "mpe", "smac"];

/// The method that is typed; RIT where none is.
pub(crate) fn named(typed: &Table) -> Result<Method, ConfigError> {
    match typed.get("algorithm").and_then(|section| section.get("name")) {
        Some(Value::String(name)) => name.parse().map_err(|_| unknown(name)),
        _ => Ok(Method::Rit),
    }
}

fn unknown(name: &str) -> ConfigError {
    let known = Method::ALL.map(Method::name);
    // Names longer than any of ours are like none of them, and comparing takes time in proportion to the length.
    let likeness = |known: &str| if name.len() > 100 { 0.0 } else { strsim::jaro_winkler(name, known) };
    let closest = known.into_iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
    let suggestion = closest.filter(|known| likeness(known) > 0.8);
    ConfigError::UnknownMethod { name: name.to_owned(), suggestion }
}

/// A run that has begun stays with its method, whatever keys another one has.
pub(crate) fn same(method: Method, settings: &[Table]) -> Result<(), ConfigError> {
    let typed =
        settings.iter().filter(|setting| setting.get("algorithm").is_some_and(|it| it.get("name").is_some()));
    for setting in typed {
        let name = named(setting)?;
        if name != method {
            return Err(ConfigError::OtherMethod { method, name });
        }
    }
    Ok(())
}

/// Before methods had names, RIT's ablations were spelled by two keys. They still are understood: their place is taken
/// by the name that means the same. `base` is what the settings below these name.
pub(crate) fn translate_ablations(typed: &mut Table, base: Method) -> Result<(), ConfigError> {
    const MIXING: &str = "mixing";
    const REPRESENTATIONS: &str = "task_representations";
    let Some(Value::Table(algorithm)) = typed.get_mut("algorithm") else { return Ok(()) };
    let (mixing, representations) = (algorithm.remove(MIXING), algorithm.remove(REPRESENTATIONS));
    if mixing.is_none() && representations.is_none() {
        return Ok(());
    }
    let base = match algorithm.get("name") {
        Some(Value::String(name)) => name.parse().map_err(|_| unknown(name))?,
        _ => base,
    };
    let kind = |key, expected| ConfigError::Value(format!("algorithm.{key} must be {expected}"));
    let facts = base.facts();
    let beside = algorithm.get("encoder").and_then(Value::as_str) == Some("beside");
    if facts.encoder != Encoder::Beside && !(base == Method::VdnInt && beside) {
        let key = if mixing.is_some() { MIXING } else { REPRESENTATIONS };
        return Err(ConfigError::Value(format!(
            "algorithm.{key} follows from algorithm.name = {base}; `rit experiments` lists the other algorithms"
        )));
    }
    let sum = match mixing {
        None => facts.mixing == Some(Mixing::Sum),
        Some(Value::String(word)) if word == "sum" => true,
        Some(Value::String(word)) if word == "network" => false,
        Some(_) => return Err(kind(MIXING, "\"network\" or \"sum\"")),
    };
    let representations = match representations {
        None => facts.task_representations,
        Some(Value::Boolean(has)) => has,
        Some(_) => return Err(kind(REPRESENTATIONS, "true or false")),
    };
    let method = match (representations, sum) {
        (true, false) => Method::Rit,
        (true, true) => Method::RitVdn,
        (false, false) => Method::RitNoTaskRepresentations,
        (false, true) => Method::VdnInt,
    };
    algorithm.remove("encoder");
    if method == Method::VdnInt {
        algorithm.insert("encoder".to_owned(), Value::from("beside"));
    }
    algorithm.insert("name".to_owned(), Value::from(method.name()));
    Ok(())
}

/// The key that `algorithm.time_limit` has replaced.
pub(crate) const TIME_LIMIT_BOOTSTRAPS: &str = "time_limit_bootstraps";

/// Puts `algorithm.time_limit` in the place of the older key that only on-policy methods had.
pub(crate) fn translate_time_limit(typed: &mut Table) -> Result<(), ConfigError> {
    let Some(Value::Table(algorithm)) = typed.get_mut("algorithm") else { return Ok(()) };
    match algorithm.remove(TIME_LIMIT_BOOTSTRAPS) {
        None => {}
        Some(Value::Boolean(bootstraps)) => {
            algorithm.insert("time_limit".to_owned(), Value::from(time_limit(bootstraps)));
        }
        Some(_) => {
            return Err(ConfigError::Value(format!(
                "algorithm.{TIME_LIMIT_BOOTSTRAPS} must be true or false"
            )));
        }
    }
    Ok(())
}

/// What `algorithm.time_limit` is where the older key was this.
pub(crate) fn time_limit(bootstraps: bool) -> &'static str {
    if bootstraps { "truncated" } else { "environment" }
}

/// A method by its name, in files.
pub(crate) mod by_name {
    use rit_algo::Method;
    use serde::{Deserialize as _, Deserializer, Serializer, de::Error as _};

    pub(crate) fn serialize<S: Serializer>(method: &Method, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(method.name())
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Method, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Config, OptimizerName, resolve, set, set_all};
    use rit_env::rollout::TimeLimit;

    fn with(task_set: &str, settings: &[&str]) -> Result<Config, ConfigError> {
        let settings: Vec<Table> = settings.iter().map(|text| set(text).unwrap()).collect();
        resolve(&format!("environment.task_set = {task_set:?}"), "test", &settings)
    }

    fn method(settings: &[&str]) -> (Method, Encoder) {
        let model = with("matrix-game", settings).unwrap().model();
        (model.method, model.encoder)
    }

    #[test]
    fn older_spellings_mean_what_they_meant() {
        let [sum, none] = ["algorithm.mixing=sum", "algorithm.task_representations=false"];
        assert_eq!(method(&[]), (Method::Rit, Encoder::Beside));
        assert_eq!(method(&[sum]), (Method::RitVdn, Encoder::Beside));
        assert_eq!(method(&[none]), (Method::RitNoTaskRepresentations, Encoder::Beside));
        for both in [&[sum, none], &[none, sum]] {
            assert_eq!(method(both), (Method::VdnInt, Encoder::Beside));
        }
        assert_eq!(method(&[sum, "algorithm.mixing=network"]), (Method::Rit, Encoder::Beside));
        assert_eq!(method(&["algorithm.name=rit-vdn", none]), (Method::VdnInt, Encoder::Beside));
        let message = with("matrix-game", &["algorithm.name=refil", sum]).unwrap_err().to_string();
        assert_eq!(
            message,
            "algorithm.mixing follows from algorithm.name = refil; `rit experiments` lists the other algorithms"
        );
        let time_limit =
            |settings: &[&str]| with("matrix-game", settings).map(|config| config.algorithm.time_limit);
        let [bootstraps, does_not] =
            ["true", "false"].map(|is| format!("algorithm.time_limit_bootstraps={is}"));
        assert_eq!(time_limit(&["algorithm.name=mat", &bootstraps]), Ok(TimeLimit::Truncated));
        assert_eq!(time_limit(&["algorithm.time_limit=terminated", &does_not]), Ok(TimeLimit::Environment));
        // An experiment of a person's own, from before.
        let experiment = "environment.task_set = 'matrix-game'\nalgorithm.mixing = 'sum'";
        let config = resolve(experiment, "test", &[set(none).unwrap()]).unwrap();
        assert_eq!(config.algorithm.name, Method::VdnInt);
    }

    #[test]
    fn a_key_that_the_method_has_not_is_refused() {
        let message = |settings: &[&str]| with("matrix-game", settings).unwrap_err().to_string();
        assert_eq!(
            message(&["algorithm.name=vdn-int", "algorithm.encoder=beside", "algorithm.imagined_weight=0.3"]),
            "algorithm.imagined_weight means nothing to vdn-int; these have it: refil"
        );
        assert_eq!(
            message(&["algorithm.encoder=beside"]),
            "algorithm.encoder means nothing to rit; these have it: qmix-attn, vdn-attn, qmix-int, vdn-int, refil, roma"
        );
        assert_eq!(
            message(&["algorithm.name=rit-vdn", "network.mixing_embed_dim=8"]),
            "network.mixing_embed_dim means nothing to rit-vdn; these have it: rit, rit-no-task-representations, \
             qmix-attn, qmix-int, updet-mix, refil, roma"
        );
        let on_policy = message(&["algorithm.name=mappo", "algorithm.buffer_size=100"]);
        assert!(on_policy.starts_with("algorithm.buffer_size means nothing to mappo; these have it: rit, "));
    }

    #[test]
    fn an_unknown_method_is_told_of_the_others() {
        let message =
            |name: &str| with("matrix-game", &[&format!("algorithm.name={name}")]).unwrap_err().to_string();
        let known = "known: rit, rit-vdn, rit-no-task-representations, qmix-attn, vdn-attn, qmix-int, vdn-int, \
                     updet-mix, updet-vdn, refil, roma, mappo, mat";
        assert_eq!(
            message("qmix-atn"),
            format!("unknown algorithm \"qmix-atn\"; did you mean \"qmix-attn\"? {known}")
        );
        assert_eq!(message("dqn"), format!("unknown algorithm \"dqn\"; {known}"));
    }

    #[test]
    fn what_is_written_holds_the_methods_own_keys_and_leads_back() {
        for method in Method::ALL {
            let config = with("cooperative-navigation", &[&format!("algorithm.name={method}")]).unwrap();
            let text = config.to_toml().unwrap();
            assert_eq!(text.contains("imagined_weight"), method == Method::Refil, "{text}");
            assert_eq!(text.contains("minibatches"), method.facts().regime == Regime::OnPolicy, "{text}");
            assert_eq!(resolve(&text, "config.toml", &[]), Ok(config));
        }
    }

    /// The specification of the on-policy methods, section 7.
    #[test]
    fn on_policy_presets_are_those_of_the_table() {
        for (name, clip, time_limit) in
            [("mappo", 0.2, TimeLimit::Environment), ("mat", 0.05, TimeLimit::Truncated)]
        {
            let algorithm =
                |task_set| with(task_set, &[&format!("algorithm.name={name}")]).unwrap().algorithm;
            let (matrix, mpe) = (algorithm("matrix-game"), algorithm("cooperative-navigation"));
            for algorithm in [&matrix, &mpe] {
                assert_eq!((algorithm.clip, algorithm.gamma, algorithm.gae_lambda), (clip, 0.99, 0.95));
                assert_eq!((algorithm.epochs, algorithm.minibatches, algorithm.policy_lag), (10, 1, 0));
                assert_eq!((algorithm.optimizer, algorithm.optimizer_eps), (OptimizerName::Adam, 1e-5));
                assert_eq!((algorithm.random_permutation, algorithm.grad_norm_clip), (false, 10.0));
            }
            assert_eq!(
                (matrix.lr, matrix.n_rollout_threads, matrix.time_limit),
                (5e-4, 32, TimeLimit::Environment)
            );
            assert_eq!((mpe.lr, mpe.n_rollout_threads, mpe.time_limit), (7e-4, 8, time_limit));
        }
        let lag =
            with("matrix-game", &["algorithm.name=mat", "algorithm.policy_lag=1"]).unwrap_err().to_string();
        assert_eq!(
            lag,
            "algorithm.policy_lag = 1: mat learns from each batch with the weights that rolled it; only 0 will do"
        );
    }

    /// An unknown key's message says what is possible, and no key that the method would refuse.
    #[test]
    fn keys_of_other_methods_are_not_listed() {
        let assignments = ["algorithm.name=mappo", "algorithm.lambda=0.3", "algorithm.name=\"vdn-attn\""];
        let message = set_all(&assignments.map(str::to_owned)).unwrap_err().to_string();
        let possible =
            "unknown key \"algorithm.lambda\"; [algorithm] has batch_size, buffer_size, encoder, epsilon_";
        assert!(message.starts_with(possible), "{message}");
        let others = [" clip,", "imagined_weight", "role_kl_weight", "gae_lambda"];
        assert!(others.iter().all(|key| !message.contains(key)), "{message}");
        // Without a method, the keys of all methods are listed.
        let message = set("algorithm.lambda=0.3").unwrap_err().to_string();
        assert!(message.contains("imagined_weight") && message.contains("gae_lambda"), "{message}");
        // And in a file of a person's own.
        let file = "environment.task_set = 'matrix-game'\nalgorithm.name = 'mappo'\nalgorithm.lambda = 0.3";
        let message = resolve(file, "test", &[]).unwrap_err().to_string();
        assert!(message.contains("gae_lambda") && !message.contains("buffer_size"), "{message}");
    }

    /// A size that a method's networks have can be set, and no other.
    #[test]
    fn a_method_has_the_keys_of_its_networks_sizes() {
        for method in Method::ALL {
            let config = with("cooperative-navigation", &[&format!("algorithm.name={method}")]).unwrap();
            let sizes: Vec<&str> = config.model().sizes().into_iter().map(|(name, _)| name).collect();
            let defaults = parse(include_str!("presets/all.toml"), "all").unwrap();
            let names = defaults["network"].as_table().unwrap().keys();
            // A file, and a bound of ROMA's roles: no sizes.
            let no_sizes = ["initial_weights", "role_variance_floor"];
            for name in names.filter(|name| !no_sizes.contains(&name.as_str())) {
                let key = format!("network.{name}");
                assert_eq!(has(method, &key), sizes.contains(&name.as_str()), "{method}: {key}");
            }
        }
    }

    /// Presets of methods may say nothing that the method has not, and for no family that there is not.
    #[test]
    fn presets_hold_keys_of_their_method() {
        let defaults = parse(include_str!("presets/all.toml"), "all").unwrap();
        for method in Method::ALL {
            let mut preset = parse(preset(method), "preset").unwrap();
            let mut parts: Vec<Table> = FAMILIES
                .iter()
                .filter_map(|family| Some(preset.remove(*family)?.try_into().unwrap()))
                .collect();
            parts.push(preset);
            for part in parts {
                assert_eq!(check(&part, method), Ok(()), "{method}");
                for (section, keys) in &part {
                    for key in keys.as_table().unwrap().keys() {
                        assert!(defaults[section].get(key).is_some(), "{method}: {section}.{key}");
                    }
                }
            }
        }
    }
}
