//! What a person types: an experiment's TOML and `--set` values.

use rit_config::{resolve, set};

/// Between the experiment and each `--set`: no argument of a program can hold it.
const BETWEEN: char = '\0';

/// Resolves an experiment under some settings, and says whether it was accepted. What is accepted is usable, and
/// what is written of it into a run directory leads back to it.
///
/// # Panics
/// When it is not, or does not.
pub fn check(input: &[u8]) -> bool {
    let Ok(text) = str::from_utf8(input) else { return false };
    let mut parts = text.split(BETWEEN);
    let experiment = parts.next().unwrap_or_default();
    let settings: Result<Vec<_>, _> = parts.map(set).collect();
    let config = match settings.and_then(|settings| resolve(experiment, "experiment.toml", &settings)) {
        Ok(config) => config,
        Err(error) => {
            assert!(!error.to_string().contains('\n'), "one line: {error}");
            return false;
        }
    };
    let epsilon = config.epsilon(config.training.t_max / 2);
    assert!((0.0..=1.0).contains(&epsilon), "epsilon {epsilon}");
    assert!(rit_algo::Model::new(config.model()).is_ok());
    for task in config.tasks(rit_env::Split::Training) {
        task.environment(config.environment_options());
    }
    let written = config.to_toml().map_err(|error| error.to_string());
    let again = written.map(|written| resolve(&written, "config.toml", &[]));
    assert_eq!(again, Ok(Ok(config)));
    true
}

/// Whole inputs to begin from: the experiments that come with the program, every key of a method, and settings.
pub fn seeds() -> Vec<(String, Vec<u8>)> {
    let all = resolve("environment.task_set = \"predator-prey\"", "experiment.toml", &[]);
    let all = all.and_then(|config| config.to_toml()).unwrap_or_default();
    let seeds = [
        ("all", all.as_str()),
        ("matrix-game", include_str!("../../../../deploy/experiments/matrix-game.toml")),
        ("vdn", include_str!("../../../../deploy/experiments/matrix-game-vdn.toml")),
        ("predator-prey-pro", include_str!("../../../../deploy/experiments/predator-prey-pro.toml")),
        ("until", "environment.task_set = \"matrix-game\"\0training.until=win_rate=1.0\0seed=9"),
        ("word", "\0environment.task_set=cooperative-navigation\0algorithm.mixing=sum\0network.n_heads=2"),
        (
            "escapes",
            "environment={\"task_set\"=\"predator\\u002Dprey\",view_radius=1_0.5e0}\0algorithm.lr=1e-3",
        ),
        ("refused", "algorithm.gama = 0x_7\n[learner]\nlisten = '''\ntcp:1'''\0=\0algorithm=[1979-05-27]"),
    ];
    seeds.map(|(name, text)| (name.to_owned(), text.as_bytes().to_vec())).into()
}
