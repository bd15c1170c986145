//! `rit shapley`: whether utilities are Shapley values, as the paper claims (proposition 1) and does not check.

mod game;
mod said;

use crate::{cli::ShapleyOptions, failure::Failure, new_file, output, player::Trained};
use game::StepGame;
use rand::seq::SliceRandom as _;
use rit_episode::{Episode, RunSeed, Stream};
use rit_learner::{checkpoint::Which, evaluation::Evaluator, trainer::evaluation_seed};
use rit_policy::weights_file;
use rit_record::{Residual, Shapley, ShapleyEstimate, Symmetry};
use rit_statistics::{
    correlation, mean,
    shapley::{PLAYERS_MAX, asymmetry, exact, permutations},
};
use std::process::ExitCode;

/// Most decision orders that utilities are averaged over.
const ORDERS_MAX: usize = 24;
/// Two agents count as symmetric at a step if no coalition gains by one of them more than this share of what the whole
/// team's actions are worth there.
const SYMMETRIC: f64 = 0.05;

/// `rit shapley`.
///
/// # Errors
/// When the run, the task or the file cannot be used, or the team is too large.
pub fn run(options: &ShapleyOptions) -> Result<ExitCode, Failure> {
    if let Some(out) = &options.out {
        if out.extension().is_none_or(|ending| ending != "svg") {
            return Err(Failure::input_message(format!(
                "--out {}: a figure's name ends in .svg",
                out.display()
            )));
        }
        new_file::check(out, options.force)?;
    }
    let trained = Trained::load(&options.run, Which::default())?;
    let task = trained.config.environment.task_set.task(&options.task)?;
    let n = task.spec().n_agents;
    if n > PLAYERS_MAX {
        return Err(Failure::input_message(format!(
            "{task} has {n} agents: exact Shapley values take every coalition and permutation, which is done for up to \
             {PLAYERS_MAX}; choose a task with fewer"
        )));
    }
    let seed = options.seed.map_or_else(|| evaluation_seed(&trained.config), RunSeed);
    let evaluator = Evaluator::new(&trained.config);
    let mut policy = trained.policy();
    let episodes = evaluator.watch(policy.as_mut(), task, 0..u64::from(options.episodes), seed, |_, _| {})?;
    let mut steps = Vec::new();
    for episode in &episodes {
        let mut of_episode = game::learned(&trained, episode, &orders(episode, seed))?;
        for at in rolled_steps(episode.steps(), options.rolled_steps.into()) {
            of_episode[at].own = game::own(&trained, task, episode, seed, at)?;
        }
        steps.extend(of_episode);
    }
    let mut found = findings(&steps, n);
    found.run = options.run.display().to_string();
    found.task = task.to_string();
    found.method = trained.model.method().facts().name.to_owned();
    found.weights_digest = weights_file::digest(&trained.params);
    found.episodes = episodes.len();
    if let Some(out) = &options.out {
        let figure = rit_report::shapley_figure(&found)?;
        new_file::write("--out", out, figure.as_bytes(), options.force)?;
    }
    if let Err(error) = found.keep(&options.run) {
        // The run may belong to another user: what was found is printed all the same.
        let _ = output::say(&format!("not kept for `rit report`: {error}"));
    }
    output::print(&if options.json { said::json(&found)? } else { said::text(&found) })?;
    Ok(ExitCode::SUCCESS)
}

/// The episode's own order, then others at random, each once.
fn orders(episode: &Episode, seed: RunSeed) -> Vec<Vec<usize>> {
    let mut all = permutations(episode.n_agents);
    let rng = &mut seed.stream(Stream::CoalitionOrders, episode.number);
    // The first is the identity: the rows as they are.
    all[1..].shuffle(rng);
    all.truncate(ORDERS_MAX);
    all
}

/// Steps spread over an episode.
fn rolled_steps(steps: usize, count: usize) -> Vec<usize> {
    let count = count.min(steps);
    (0..count).map(|at| at * steps / count.max(1)).collect()
}

/// What all steps say.
fn findings(steps: &[StepGame], n: usize) -> Shapley {
    let shapley: Vec<Vec<f64>> = steps.iter().map(|step| exact(&step.learned, n)).collect();
    let own: Vec<Option<Vec<f64>>> =
        steps.iter().map(|step| (!step.own.is_empty()).then(|| exact(&step.own, n))).collect();
    let first: Vec<&[f64]> = steps.iter().map(|step| &step.utilities[0][..]).collect();
    let learned_pairs = pairs(first.iter().copied().zip(shapley.iter().map(|it| &it[..])));
    let with_own = || steps.iter().enumerate().filter_map(|(at, _)| Some((at, own[at].as_deref()?)));
    let own_pairs = pairs(with_own().map(|(at, own)| (first[at], own)));
    let both_pairs = pairs(with_own().map(|(at, own)| (&shapley[at][..], own)));
    let (centred, own_centred) = (centred(&learned_pairs, n), centred(&own_pairs, n));
    let count =
        |limit: &usize| steps.iter().map(|step| step.utilities.len()).min().is_some_and(|it| *limit <= it);
    let estimates = [1, 2, 4, 6, 12, 24].into_iter().filter(count).map(|orders| {
        let averaged: Vec<Vec<f64>> = steps.iter().map(|step| averaged(step, orders, n)).collect();
        let pairs = pairs(averaged.iter().map(|it| &it[..]).zip(shapley.iter().map(|it| &it[..])));
        let errors: Vec<f64> = pairs.iter().map(|(a, b)| (a - b).abs()).collect();
        ShapleyEstimate { orders, mean_error: mean(&errors), correlation: correlation(&pairs) }
    });
    Shapley {
        agents: n,
        steps: steps.len(),
        rolled_steps: own_pairs.len() / n,
        utilities_learned: correlation(&learned_pairs),
        utilities_own: correlation(&own_pairs),
        learned_own: correlation(&both_pairs),
        within_steps_learned: correlation(&centred),
        within_steps_own: correlation(&own_centred),
        estimates: estimates.collect(),
        mean_shapley: mean(&shapley.iter().flatten().map(|value| value.abs()).collect::<Vec<_>>()),
        efficiency: efficiency(steps, &shapley),
        symmetry: symmetry(steps, &shapley, n),
        points: learned_pairs.iter().map(|&(a, b)| [b, a]).collect(),
        own_points: own_pairs.iter().map(|&(a, b)| [b, a]).collect(),
        ..Shapley::default()
    }
}

fn pairs<'a>(steps: impl Iterator<Item = (&'a [f64], &'a [f64])>) -> Vec<(f64, f64)> {
    steps.flat_map(|(a, b)| a.iter().copied().zip(b.iter().copied()).collect::<Vec<_>>()).collect()
}

/// Less each step's mean.
fn centred(pairs: &[(f64, f64)], n: usize) -> Vec<(f64, f64)> {
    let of_step = |step: &[(f64, f64)]| {
        let (a, b): (Vec<f64>, Vec<f64>) = step.iter().copied().unzip();
        let (a, b) = (mean(&a), mean(&b));
        step.iter().map(|&(x, y)| (x - a, y - b)).collect::<Vec<_>>()
    };
    pairs.chunks_exact(n).flat_map(of_step).collect()
}

/// Equation 10: the mean of utilities over so many orders.
fn averaged(step: &StepGame, orders: usize, n: usize) -> Vec<f64> {
    let of_agent = |agent: usize| step.utilities[..orders].iter().map(move |utilities| utilities[agent]);
    (0..n).map(|agent| mean(&of_agent(agent).collect::<Vec<_>>())).collect()
}

fn efficiency(steps: &[StepGame], shapley: &[Vec<f64>]) -> Vec<Residual> {
    let residual = |sum: &str, of: &str, parts: &dyn Fn(usize) -> (f64, f64)| {
        let all: Vec<(f64, f64)> = (0..steps.len()).map(parts).collect();
        let errors: Vec<f64> = all.iter().map(|(sum, of)| (sum - of).abs()).collect();
        let sizes: Vec<f64> = all.iter().map(|(_, of)| of.abs()).collect();
        let (sum, of) = (sum.to_owned(), of.to_owned());
        Residual { sum, of, mean_error: mean(&errors), mean_size: mean(&sizes) }
    };
    let shapley_sum = |at: usize| shapley[at].iter().sum::<f64>();
    let utility_sum = |at: usize| steps[at].utilities[0].iter().sum::<f64>();
    let grand = |at: usize| *steps[at].learned.last().unwrap_or(&f64::NAN);
    let worth = |at: usize| grand(at) - steps[at].learned[0];
    vec![
        residual("Shapley values", "v(N) − v(∅), the learned game", &|at| (shapley_sum(at), worth(at))),
        residual("Shapley values", "reward of the step (lemma 1)", &|at| (shapley_sum(at), steps[at].reward)),
        residual("Shapley values", "return from the step on", &|at| {
            (shapley_sum(at), steps[at].return_to_go)
        }),
        residual("utilities", "v(N) − v(∅), the learned game", &|at| (utility_sum(at), worth(at))),
        residual("utilities", "Q_total", &|at| (utility_sum(at), grand(at))),
        residual("utilities", "return from the step on", &|at| (utility_sum(at), steps[at].return_to_go)),
    ]
}

fn symmetry(steps: &[StepGame], shapley: &[Vec<f64>], n: usize) -> Symmetry {
    let mut gaps: [Vec<f64>; 3] = Default::default();
    for (step, shapley) in steps.iter().zip(shapley) {
        let worth = step.learned.last().map_or(0.0, |grand| (grand - step.learned[0]).abs());
        let all = averaged(step, step.utilities.len(), n);
        for (a, b) in (0..n).flat_map(|a| (0..a).map(move |b| (a, b))) {
            if worth > 0.0 && asymmetry(&step.learned, a, b) <= SYMMETRIC * worth {
                let utilities = &step.utilities[0];
                for (gaps, values) in gaps.iter_mut().zip([shapley, utilities, &all]) {
                    gaps.push((values[a] - values[b]).abs());
                }
            }
        }
    }
    let [shapley, utilities, averaged] = gaps;
    let of = |gaps: &[f64]| if gaps.is_empty() { 0.0 } else { mean(gaps) };
    Symmetry {
        pairs: shapley.len(),
        shapley: of(&shapley),
        utilities: of(&utilities),
        averaged: of(&averaged),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(learned: Vec<f64>, own: Vec<f64>, utilities: Vec<Vec<f64>>) -> StepGame {
        StepGame { learned, own, reward: 3.0, return_to_go: 4.0, utilities }
    }

    #[test]
    fn utilities_that_are_shapley_values_are_found_to_be() {
        // v = 1 + 2·[0] + 4·[1] + 2·[both]: φ = (3, 5). The second order gives the mirror error of the first.
        let game = vec![1.0, 3.0, 5.0, 9.0];
        let other = vec![0.0, 1.0, 1.0, 2.0];
        let steps = [
            step(game.clone(), game, vec![vec![2.0, 6.0], vec![4.0, 4.0]]),
            step(other.clone(), Vec::new(), vec![vec![1.0, 1.0], vec![1.0, 1.0]]),
        ];
        let found = findings(&steps, 2);
        let errors: Vec<f64> = found.estimates.iter().map(|it| it.mean_error).collect();
        assert_eq!(errors, [0.5, 0.0]);
        assert_eq!((found.steps, found.rolled_steps, found.mean_shapley), (2, 1, 2.5));
        assert!((found.learned_own.unwrap() - 1.0).abs() < 1e-12);
        // Of the first step the differences from the mean are (−2, 2) against (−1, 1), of the second none.
        assert!((found.within_steps_learned.unwrap() - 1.0).abs() < 1e-12);
        let errors: Vec<f64> = found.efficiency.iter().map(|it| it.mean_error).collect();
        // Sums of φ: 8 and 2, of utilities: 8 and 2; Q_total: 9 and 2; reward 3, return 4.
        assert_eq!(errors, [0.0, 3.0, 3.0, 0.0, 0.5, 3.0]);
        let symmetry = found.symmetry;
        assert_eq!((symmetry.pairs, symmetry.shapley, symmetry.utilities), (1, 0.0, 0.0));
    }

    #[test]
    fn rolled_steps_are_spread_over_an_episode() {
        assert_eq!(rolled_steps(25, 5), [0, 5, 10, 15, 20]);
        assert_eq!(rolled_steps(2, 5), [0, 1]);
        assert_eq!(rolled_steps(2, 0), [0_usize; 0]);
    }
}
