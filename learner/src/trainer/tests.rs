use super::*;
use crate::write_queue::{ToWrite, write_queue};
use rit_algo::{Method, Model};
use rit_config::OwnedRunDir;
use rit_env::{
    Script,
    rollout::{Job, Rollout, all_rolled},
};
use rit_episode::Choice;

/// Batches of random play, as long as the trainer takes them.
fn batches(config: &Config, count: u64) -> Vec<Work> {
    let size = config.algorithm.n_rollout_threads as u64;
    let tasks = config.tasks(Split::Training);
    let mut rollout = Rollout::new(tasks, rit_worlds::factory(config), config.seed, true);
    let mut batch = |first: u64| {
        let job = |number| Job { number, weights_version: 0, choice: Choice::EpsilonGreedy(1.0), task: None };
        let jobs: Vec<Job> = (first..first + size).map(job).collect();
        Work::Batch(all_rolled(rollout.roll(&mut Script::Random, &jobs)).unwrap())
    };
    (0..count).map(|index| batch(index * size)).collect()
}

/// A trainer of a new run.
fn trainer(config: &Config, run_dir: &RunDir, writer: WriteQueue) -> Trainer {
    let model = Arc::new(Model::new(config.model()).unwrap());
    let params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
    let learner = model.learner(config.update(), params).unwrap();
    let algorithm = Algorithm { model, learner };
    let news = Box::new(|_| ());
    let made = Made::default();
    Trainer::new(config.clone(), run_dir.clone(), algorithm, None, news, writer, made).unwrap().0
}

/// The end of a run waits for room on the disk, for ten minutes if need be, and not for a thread that is no more.
#[test]
fn a_writer_that_has_gone_is_not_waited_for() {
    let settings = ["network.hidden_dim=8", "evaluation.episodes=1"];
    let settings = settings.map(|text| rit_config::set(text).unwrap());
    let config = rit_config::resolve("environment.task_set = 'matrix-game'", "test", &settings).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let made = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap();
    let (writer, reader) = write_queue(1);
    let trainer = trainer(&config, made.run_dir(), writer);
    drop(reader);
    let (work, queue) = mpsc::channel();
    work.send(Work::Stop(Ended::Stopped)).unwrap();
    let begun = std::time::Instant::now();
    let ended = trainer.run(&queue);
    let Err(TrainError::Checkpoint(why)) = ended else { panic!("{ended:?}") };
    assert!(why.contains("the write thread panicked"), "{why}");
    let limit_ms = u128::from(config.checkpoints.last_retry_ms);
    assert!(begun.elapsed().as_millis() < limit_ms, "{limit_ms} ms are the longest it waits");
}

/// Weights so large that no sum of them is a number. What is not finite reaches neither the weights that actors get nor a
/// checkpoint.
#[test]
fn an_update_that_is_not_finite_ends_the_run_before_it_reaches_anything() {
    for method in Method::ALL {
        let settings = [&format!("algorithm.name={method}"), "network.hidden_dim=8", "evaluation.episodes=1"];
        let mut settings: Vec<_> = settings.iter().map(|text| rit_config::set(text).unwrap()).collect();
        if method.facts().regime == Regime::Replay {
            settings.push(rit_config::set("algorithm.batch_size=2").unwrap());
        }
        let config = rit_config::resolve("environment.task_set = 'matrix-game'", "test", &settings).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let made = OwnedRunDir::create(&folder.path().join("run"), &config).unwrap();
        let run_dir = made.run_dir().clone();
        let model = Arc::new(Model::new(config.model()).unwrap());
        let mut params = model.initial(&mut config.seed.stream(Stream::Weights, 0));
        params.iter_mut().for_each(|weight| *weight = (*weight * 1e38).clamp(f32::MIN, f32::MAX));
        let learner = model.learner(config.update(), params.clone()).unwrap();
        assert_eq!(learner.regime(), method.facts().regime, "{method}");
        let algorithm = Algorithm { model, learner };
        let (writer, written) = write_queue(config.replay_episodes().max(100));
        let (trainer, board) =
            Trainer::new(config.clone(), run_dir, algorithm, None, Box::new(|_| ()), writer, Made::default())
                .unwrap();
        let (work, queue) = mpsc::channel();
        batches(&config, 3).into_iter().for_each(|batch| work.send(batch).unwrap());
        let ended = trainer.run(&queue);
        let Err(error @ TrainError::NotFinite { update: 1, .. }) = ended else {
            panic!("{method}: {ended:?}")
        };
        assert!(error.to_string().contains("is not finite in update 1"), "{error}");
        assert_eq!((board.newest().version, board.newest().to_params()), {
            let acting = Model::new(config.model()).unwrap().acting();
            (0, params[acting].to_vec())
        });
        let checkpoints =
            std::iter::from_fn(|| written.next()).filter(|what| matches!(what, ToWrite::Checkpoint(_)));
        assert_eq!(checkpoints.count(), 0, "{method}");
    }
}
