//! `rit render`: episodes as pictures. One part draws what an episode looks like on any [`canvas::Canvas`], the
//! others put it into a file.

mod canvas;
mod gif;
mod ink;
mod layout;
mod plot;
mod png;
mod raster;
mod recording;
mod svg;
mod view;

use crate::{
    cli::RenderOptions,
    failure::Failure,
    new_file, output,
    player::{Player, Trained},
};
use recording::{Film, Recording};
use rit_episode::RunSeed;
use rit_learner::{checkpoint::Which, evaluation::Evaluator, trainer::evaluation_seed};
use std::{ops::Range, path::Path, process::ExitCode};

/// What a file's ending asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    /// Step after step.
    Gif,
    /// A row of moments an episode.
    Png,
    /// A plot of each episode's course.
    Svg,
}

impl Format {
    fn of(path: &Path) -> Result<Self, Failure> {
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        match ending.as_deref() {
            Some("gif") => Ok(Self::Gif),
            Some("png") => Ok(Self::Png),
            Some("svg") => Ok(Self::Svg),
            _ => Err(Failure::input_message(format!(
                "--out {}: a picture's name ends in .gif, .png or .svg",
                path.display()
            ))),
        }
    }
}

/// `rit render`.
pub fn run(options: &RenderOptions) -> Result<ExitCode, Failure> {
    let format = Format::of(&options.out)?;
    new_file::check(&options.out, options.force)?;
    let film = record(options)?;
    let bytes = match format {
        Format::Gif => gif::encode(&film)?,
        Format::Png => png::encode(&film)?,
        Format::Svg => svg::encode(&film).into_bytes(),
    };
    new_file::write("--out", &options.out, &bytes, options.force)?;
    let returns: Vec<_> =
        film.episodes.iter().map(|episode| format!("{:.2}", episode.episode.total_reward())).collect();
    output::print(&format!(
        "{}: {} by {}, {} kB, return {}\n",
        options.out.display(),
        film.task,
        film.policy,
        bytes.len().div_ceil(1000),
        returns.join(", ")
    ))?;
    Ok(ExitCode::SUCCESS)
}

/// One greedy episode of a run's checkpoint, step by step, as `.gif`.
///
/// # Errors
/// When the run has no checkpoint, there is no such task, or nothing in it can be drawn.
pub fn replay(run: &Path, task: &str, number: u64) -> Result<Vec<u8>, Failure> {
    let trained = Trained::load(run, Which::default())?;
    let (policy, seed) = (trained.policy(), evaluation_seed(&trained.config));
    let player =
        Player { name: "checkpoint".to_owned(), config: trained.config, policy, weights_digest: None };
    gif::encode(&film(player, task, number..number + 1, seed)?)
}

/// Rolls the episodes that are asked for.
fn record(options: &RenderOptions) -> Result<Film, Failure> {
    let player = Player::new(&options.play)?;
    let seed = player.seed(options.seed);
    film(player, &options.task, 0..u64::from(options.episodes), seed)
}

/// Rolls episodes of these numbers and keeps what can be drawn of them.
fn film(mut player: Player, task: &str, numbers: Range<u64>, seed: RunSeed) -> Result<Film, Failure> {
    let task = player.config.environment.task_set.task(task)?;
    let mut scenes = vec![Vec::new(); (numbers.end - numbers.start) as usize];
    let evaluator = Evaluator::new(&player.config);
    let episodes = evaluator.watch(player.policy.as_mut(), task, numbers, seed, |episode, world| {
        scenes[episode].extend(world.scene());
    })?;
    if scenes.iter().any(Vec::is_empty) {
        return Err(Failure::input_message(format!(
            "{task} is played on a table of rewards, where nothing has a place: there is nothing to draw; \
             `rit evaluate` measures it"
        )));
    }
    let pairs = scenes.into_iter().zip(episodes);
    let episodes = pairs.map(|(scenes, episode)| Recording { task, scenes, episode }).collect();
    Ok(Film { task, policy: player.name, episodes })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ending_says_what_is_drawn() {
        let format = |name: &str| Format::of(Path::new(name)).ok();
        assert_eq!(format("a/b.gif"), Some(Format::Gif));
        assert_eq!(format("b.PNG"), Some(Format::Png));
        assert_eq!(format("b.c.svg"), Some(Format::Svg));
        for name in ["gif", "a.jpeg", "a.gif/b", ".svg"] {
            assert_eq!(format(name), None, "{name}");
        }
    }
}
