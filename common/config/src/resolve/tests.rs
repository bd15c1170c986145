use super::*;
use crate::{OptimizerName, Until};

const MATRIX: &str = "environment.task_set = \"matrix-game\"";

fn with(settings: &[&str]) -> Result<Config, ConfigError> {
    let settings: Vec<Table> = settings.iter().map(|text| set(text)).collect::<Result<_, _>>()?;
    resolve(MATRIX, "test", &settings)
}

#[test]
fn table_ii_is_what_the_presets_say() {
    let matrix = with(&[]).unwrap();
    let algorithm = &matrix.algorithm;
    assert_eq!((algorithm.batch_size, algorithm.buffer_size, algorithm.n_rollout_threads), (32, 5000, 1));
    assert_eq!((algorithm.lr, algorithm.optimizer), (5e-4, OptimizerName::RmsProp));
    assert_eq!((algorithm.rmsprop_alpha, algorithm.optimizer_eps), (0.99, 1e-5));
    assert_eq!((matrix.training.t_max, matrix.network.task_representation_dim), (50_000, 32));
    for name in ["cooperative-navigation", "predator-prey", "predator-prey-pro"] {
        let mpe = resolve(&format!("environment.task_set = {name:?}"), "test", &[]).unwrap();
        let algorithm = &mpe.algorithm;
        assert_eq!((algorithm.batch_size, algorithm.buffer_size, algorithm.n_rollout_threads), (64, 5000, 8));
        assert_eq!(
            (algorithm.lr, algorithm.optimizer, algorithm.optimizer_eps),
            (1e-3, OptimizerName::Adam, 1e-8)
        );
        assert_eq!((mpe.training.t_max, mpe.network.task_representation_dim), (5_050_000, 20));
        assert_eq!((algorithm.epsilon_anneal_steps, algorithm.target_update_interval), (50_000, 200));
    }
}

#[test]
fn the_command_line_is_above_the_experiment() {
    let config = with(&["algorithm.gamma=0.5", "algorithm.mixing=sum", "seed=9"]).unwrap();
    assert_eq!((config.algorithm.gamma, config.algorithm.name), (0.5, Method::RitVdn));
    assert_eq!(config.seed.0, 9);
    assert_eq!(with(&["training.until=win_rate=1.0"]).unwrap().training.until, Until::WinRate(1.0));
    assert_eq!(with(&["algorithm.gamma=1", "algorithm.gamma=0"]).unwrap().algorithm.gamma, 0.0);
}

#[test]
fn what_weights_follow_from_is_told_from_what_they_do_not() {
    let settings = |text: &str| with(&[text]).unwrap().result_settings().unwrap();
    let keys = settings("algorithm.gamma=0.99");
    let value = |key: &str| keys.get(key).map(String::as_str);
    assert_eq!(
        (value("algorithm.gamma"), value("environment.task_set")),
        (Some("0.99"), Some("matrix-game"))
    );
    for key in
        ["seed", "algorithm.policy_lag", "algorithm.epsilon_finish", "network.hidden_dim", "learner.shards"]
    {
        assert!(keys.contains_key(key), "{key}");
    }
    for free in
        ["training.t_max=7", "actors.count=3", "learner.threads=2", "checkpoints.keep=9", "web.listen=off"]
    {
        assert_eq!(settings(free), keys, "{free}");
    }
    assert_ne!(settings("algorithm.gamma=0.5"), keys);
    assert!(is_live("algorithm.epsilon_finish") && !is_live("algorithm.gamma"));
}

#[test]
fn what_is_written_leads_back() {
    let config = with(&["environment.view_radius=inf", "algorithm.lr=0.25"]).unwrap();
    let text = config.to_toml().unwrap();
    assert_eq!(resolve(&text, "config.toml", &[]), Ok(config));
}

/// Why these settings are refused, by `set` or by `resolve`.
fn refused(settings: &[&str]) -> String {
    with(settings).unwrap_err().to_string()
}

/// Why an experiment's text is refused.
fn refused_file(text: &str) -> String {
    resolve(text, "my.toml", &[]).unwrap_err().to_string()
}

#[test]
fn errors_name_the_key_and_the_remedy() {
    for (setting, message) in [
        ("algorithm.gamma=7", "algorithm.gamma = 7 is out of range 0..=1"),
        ("algorithm.gamma=nan", "algorithm.gamma = NaN is out of range 0..=1"),
        ("algorithm.gamma=high", "algorithm.gamma must be a number, not \"high\""),
        ("algorithm.lr=1e30", "algorithm.lr = 1e30 is out of range 1e-12..=1"),
        ("algorithm.lr=1e-13", "algorithm.lr = 1e-13 is out of range 1e-12..=1"),
        ("algorithm.rmsprop_alpha=1", "algorithm.rmsprop_alpha = 1 is out of range 0..=0.999999"),
        ("algorithm.batch_size=-1", "algorithm.batch_size must be a whole number of at least 0, not -1"),
        (
            "algorithm.batch_size=32.0",
            "algorithm.batch_size must be a whole number of at least 0, not 32.0; write 32",
        ),
        (
            "algorithm.batch_size=many",
            "algorithm.batch_size must be a whole number of at least 0, not \"many\"",
        ),
        ("algorithm.batch_size=6000", "algorithm.batch_size = 6000 is out of range 1..=5000"),
        (
            "algorithm.task_representations=no",
            "algorithm.task_representations must be true or false, not \"no\"",
        ),
        ("seed=18446744073709551615", "seed = 18446744073709551615 is out of range 0..=9223372036854775807"),
        ("training.t_max=1e30", "training.t_max = 1e30 is out of range 0..=9223372036854775807"),
        ("training.t_max=2e12", "training.t_max = 2000000000000 is out of range 1..=1000000000000"),
        (
            "environment.approach_shaping=5",
            "environment.approach_shaping means nothing to matrix-game; leave it out",
        ),
        ("environment.physics=mpe2", "environment.physics means nothing to matrix-game; leave it out"),
        ("environment.physics=mpe", "environment.physics = \"mpe\" is not one of: original, mpe2"),
        ("environment.view_radius=1", "environment.view_radius means nothing to matrix-game; leave it out"),
        ("network.n_heads=3", "network.attention_dim = 64 is not a multiple of network.n_heads = 3"),
        ("algorithm.mixing=vdn", "algorithm.mixing must be \"network\" or \"sum\""),
        (
            "environment.spawn_rotate=x",
            "environment.spawn_rotate = \"x\" is not one of: published, always, never",
        ),
        ("algorithm.optimizer=sgd", "algorithm.optimizer = \"sgd\" is not one of: rmsprop, adam"),
        ("web.listen=8080", "web.listen = \"8080\"; write \"127.0.0.1:PORT\" or \"off\""),
        (
            "algorithm.gamma",
            "--set \"algorithm.gamma\": write --set section.key=value, such as --set algorithm.lr=0.0005",
        ),
        (
            "algorithm={gamma=0.5}",
            "algorithm must be a section, not a value: set one of its keys, such as algorithm.batch_size",
        ),
    ] {
        assert_eq!(refused(&[setting]), message, "{setting}");
    }
    assert_eq!(
        refused(&["algorithm.name=mappo", "algorithm.value_norm_beta=1"]),
        "algorithm.value_norm_beta = 1 is out of range 0..=0.999999"
    );
    assert_eq!(
        refused(&["algorithm.name=refil", "algorithm.encoder=x"]),
        "algorithm.encoder = \"x\" is not one of: within, beside"
    );
    assert!(refused(&["training.until=win_rate=2"]).contains("write win_rate=NUMBER"));
    assert!(refused(&["web.listen=0.0.0.0:8080"]).contains("ssh -L 8080:127.0.0.1:8080 THIS-MACHINE"));
    assert!(
        refused(&["environment.task_set=chess"]).contains("unknown task set \"chess\"; known: matrix-game")
    );
    assert!(refused_file("").contains("names no environment.task_set"));
    assert_eq!(
        refused_file(&format!("{MATRIX}\nseed = 9223372036854775808")),
        "my.toml, line 2, column 8: 9223372036854775808 is out of range -9223372036854775808..=9223372036854775807"
    );
}

#[test]
fn a_key_that_is_not_there_gets_the_one_that_was_meant_or_those_there_are() {
    for (setting, advice) in [
        ("algorithm.gama=0.9", "unknown key \"algorithm.gama\"; did you mean algorithm.gamma?"),
        ("gamma=0.9", "unknown key \"gamma\"; did you mean algorithm.gamma?"),
        ("learner.gamma=0.9", "unknown key \"learner.gamma\"; did you mean algorithm.gamma?"),
        (
            "learner.device=cuda",
            "unknown key \"learner.device\"; [learner] has listen, metrics_every_env_steps, shards, \
             stall_timeout_ms, threads, tls, token_file",
        ),
        ("zzz.qqq=1", "unknown key \"zzz.qqq\"; a key is one of actors, algorithm,"),
        ("seed\n8=1", "unknown key \"seed\\n8\"; "),
        ("=1", "--set \"=1\": write --set section.key=value"),
    ] {
        let message = refused(&[setting]);
        assert!(message.starts_with(advice), "{message}");
    }
    let endless = "gamma".repeat(1_000_000);
    let message = refused(&[&format!("{endless}=1")]);
    assert!(message.len() < 400 && message.contains("gammagamma\"…"), "{message}");
    assert_eq!(keys_like("lr"), ["algorithm.lr"]);
    assert_eq!(keys_like("batch-size"), ["algorithm.batch_size"]);
    assert_eq!(keys_like("bach-size"), ["algorithm.batch_size"]);
    assert_eq!(keys_like("listen"), ["learner.listen", "web.listen"]);
    assert!(keys_like("zzz").is_empty());
}

#[test]
fn one_setting_sets_one_key() {
    assert_eq!(
        refused(&["training.t_max=6\nseed=9"]),
        "training.t_max must be a whole number of at least 0, not \"6\\nseed=9\""
    );
    let message = refused(&["training.until=mean_return=1\nseed=9"]);
    assert!(message.contains("\"mean_return=1\\nseed=9\""), "{message}");
    let quoted = set("learner.token_file=\"a b\"").unwrap();
    assert_eq!(quoted, set("learner.token_file=a b").unwrap());
    assert_eq!(quoted["learner"]["token_file"].as_str(), Some("a b"));
}

#[test]
fn a_list_is_written_as_in_toml_or_with_commas() {
    for text in ["[\"game-1\", \"game-4\"]", "game-1,game-4", "game-1, game-4"] {
        let config = with(&[&format!("environment.training_tasks={text}")]).unwrap();
        assert_eq!(config.environment.training_tasks, ["game-1", "game-4"], "{text}");
    }
    assert!(refused(&["environment.training_tasks=[1"]).contains("must be a list, not \"[1\""));
    assert!(refused(&["environment.training_tasks=game-9"]).starts_with("environment.training_tasks: "));
}

/// A task that counts twice would be drawn twice as often, and a world of it be built twice.
#[test]
fn a_list_has_no_task_twice_whatever_it_is_called() {
    let of = |task_set: &str, key: &str, names: &str| {
        let text = format!("environment.task_set = {task_set:?}");
        let setting = set(&format!("environment.{key}={names}")).unwrap();
        resolve(&text, "test", &[setting]).map_err(|error| error.to_string())
    };
    for (task_set, key, first, second) in [
        ("matrix-game", "training_tasks", "game-1", "game-1"),
        ("3-8m", "training_tasks", "3m", "3m-vs-3m"),
        ("3-8MMM", "testing_tasks", "1m2M", "2M1m"),
    ] {
        assert_eq!(
            of(task_set, key, &format!("{first},{second}")).unwrap_err(),
            format!("environment.{key} lists one task twice, as {first} and as {second}; leave one out")
        );
    }
    // Another name for a task is understood, and so is a task that both lists have.
    assert!(of("3-8m", "training_tasks", "3m-vs-3m,4m,3m-vs-4m").is_ok());
    assert!(of("3-8m", "testing_tasks", "3m").is_ok());
    for name in ["navigation-03-3", "navigation-+3-3"] {
        let refused = of("cooperative-navigation", "training_tasks", name).unwrap_err();
        let begins = format!("environment.training_tasks: unknown task {name:?}");
        assert!(refused.starts_with(&begins), "{refused}");
    }
}

#[test]
fn counts_may_be_written_short() {
    for text in ["1e6", "1000k", "1M", "1_000_000", "1000000"] {
        let config = with(&[&format!("training.t_max={text}")]).unwrap();
        assert_eq!(config.training.t_max, 1_000_000, "{text}");
    }
    let largest = with(&["seed=9223372036854775807"]).unwrap();
    assert_eq!(largest.seed.0, 9_223_372_036_854_775_807);
    assert_eq!(resolve(&largest.to_toml().unwrap(), "config.toml", &[]), Ok(largest));
    assert_eq!(with(&["algorithm.grad_norm_clip=1k"]).unwrap().algorithm.grad_norm_clip, 1000.0);
}

#[test]
fn a_bound_is_within_its_bounds_and_leads_back() {
    for setting in [
        "algorithm.lr=1e-12",
        "algorithm.lr=1",
        "algorithm.optimizer_eps=1e-12",
        "algorithm.rmsprop_alpha=0.999999",
    ] {
        let config = with(&[setting]).unwrap();
        assert_eq!(resolve(&config.to_toml().unwrap(), "config.toml", &[]), Ok(config), "{setting}");
    }
    let text = with(&["algorithm.lr=0.001", "algorithm.gamma=0.9"]).unwrap().to_toml().unwrap();
    assert!(text.contains("lr = 0.001\n") && text.contains("gamma = 0.9\n"), "{text}");
}

#[test]
fn an_end_that_no_task_reaches_is_refused() {
    assert!(with(&["training.until=win_rate=0.5"]).is_ok());
    for name in ["cooperative-navigation", "predator-prey", "predator-prey-pro"] {
        let text = format!("environment.task_set = {name:?}\ntraining.until = \"win_rate=0.5\"");
        assert_eq!(
            refused_file(&text),
            format!(
                "training.until = \"win_rate=0.5\": the tasks of {name} know no winning, so that is never \
                 reached; write mean_return=NUMBER"
            )
        );
    }
}

#[test]
fn a_best_policy_is_kept_by_what_its_tasks_know() {
    let kept = |text: &str| with(&[text]).unwrap().checkpoints.keep_best;
    assert_eq!(kept("checkpoints.keep_best=win_rate"), KeepBest::WinRate);
    assert_eq!((kept("checkpoints.keep_best="), kept("seed=1")), (KeepBest::Never, KeepBest::Never));
    assert!(
        refused(&["checkpoints.keep_best=loss"])
            .starts_with("checkpoints.keep_best = \"loss\"; write mean_return")
    );
    assert!(
        refused(&["evaluation.absolute_metric=true"]).contains("set checkpoints.keep_best to mean_return")
    );
    assert!(with(&["evaluation.absolute_metric=true", "checkpoints.keep_best=mean_return"]).is_ok());
    let text = "environment.task_set = \"predator-prey\"\ncheckpoints.keep_best = \"win_rate\"";
    assert!(refused_file(text).contains("the tasks of predator-prey know no winning; write mean_return"));
}

#[test]
fn what_is_no_toml_is_said_with_its_place() {
    for (text, place) in [
        ("a = = b", "my.toml, line 1, column 5: "),
        ("seed = 1\n\n# ä\n\"ä\" = x\n", "my.toml, line 4, column 7: "),
        ("seed = 1\nseed = 2\n", "my.toml, line 2, column 1: "),
        ("seed = 18446744073709551615\n", "my.toml, line 1, column 8: "),
    ] {
        let message = refused_file(text);
        assert!(message.starts_with(place), "{message}");
    }
    for text in ["a = = b", "seed = 1\nseed = 2", "[a\n]", "a = '''\nb"] {
        assert!(!refused_file(text).contains('\n'), "one line: {}", refused_file(text));
    }
}

#[test]
fn a_file_has_whole_numbers_written_as_such() {
    let refused = |value: &str| refused_file(&format!("{MATRIX}\ntraining.t_max = {value}"));
    let must = "training.t_max must be a whole number of at least 0, not ";
    assert_eq!(refused("1e6"), format!("{must}1000000.0; write 1000000"));
    assert_eq!(refused("0.5"), format!("{must}0.5"));
    assert_eq!(refused("\"5\""), format!("{must}\"5\""));
    assert_eq!(refused("[5]"), format!("{must}a list"));
    assert_eq!(refused_file(&format!("algorithm = 5\n{MATRIX}")), "algorithm must be a section, not 5");
}
