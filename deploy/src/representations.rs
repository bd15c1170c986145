//! Figure 6 of the paper: where task representations lie, on a map, and what a map cannot say.

use crate::{failure::Failure, player::Trained};
use rit_env::{Split, Task};
use rit_episode::{Episode, RunSeed, Stream};
use rit_learner::{checkpoint::Which, evaluation::Evaluator, trainer::evaluation_seed};
use rit_report::{
    Figure, Group, Section, Table,
    chart::{self, Key, Points},
    signed,
};
use rit_statistics::{distance, mean, silhouette, t_sne};
use std::path::Path;

/// Episodes of each task, as in the paper; fewer where a task set has so many that a map would take minutes.
const EPISODES: usize = 16;
/// Most points on a map.
const POINTS_MAX: usize = 1500;
/// About how many neighbours each point minds.
const PERPLEXITY: f64 = 30.0;

/// A task's representations: those of each agent after each episode's last step.
struct TaskPoints {
    task: Task,
    unseen: bool,
    points: Vec<Vec<f32>>,
}

/// The figure and table of each group that has a run with task representations and its weights: of the first such run.
///
/// # Errors
/// When a checkpoint cannot be used or an environment cannot go on.
pub fn section(groups: &[Group], seed: u64) -> Result<Section, Failure> {
    let mut section = Section::new("representations", "Task representations");
    for group in groups {
        let runs = group.methods.iter().flat_map(|method| method.runs.iter().map(move |run| (method, run)));
        let has_weights = |path: &Path| path.join("checkpoints").is_dir();
        for (method, run) in runs.filter(|(_, run)| has_weights(&run.path)) {
            let trained = Trained::load(&run.path, Which::default())?;
            if !trained.model.method().facts().task_representations {
                continue;
            }
            let tasks = roll(&trained)?;
            let of_run = run.seed.map_or_else(String::new, |seed| format!(", seed {seed}"));
            let whose = format!("{}: {}{of_run}", group.title, method.label);
            section.figures.push(figure(&tasks, &group.id, &whose, seed)?);
            section.tables.push(table(&tasks, &group.id, &whose));
            break;
        }
    }
    if !section.is_empty() {
        section.text.push(
            "Each point is what one agent makes of its episode: its task representation after the last step of a greedy \
             episode. A map of two dimensions shows neighbourhoods and neither distances nor densities; silhouettes and \
             nearest tasks are measured in all dimensions."
                .to_owned(),
        );
    }
    Ok(section)
}

fn roll(trained: &Trained) -> Result<Vec<TaskPoints>, Failure> {
    let evaluator = Evaluator::new(&trained.config);
    let mut policy = trained.policy();
    let (training, testing) = (trained.config.tasks(Split::Training), trained.config.tasks(Split::Testing));
    let all = training.iter().map(|task| (*task, false)).chain(testing.iter().map(|task| (*task, true)));
    let all: Vec<(Task, bool)> = all.collect();
    let agents: usize = all.iter().map(|(task, _)| task.spec().n_agents).sum();
    let episodes = (POINTS_MAX / agents.max(1)).clamp(1, EPISODES) as u64;
    let seed = evaluation_seed(&trained.config);
    let of_task = |(task, unseen): (Task, bool)| {
        let rolled = evaluator.watch(policy.as_mut(), task, 0..episodes, seed, |_, _| {})?;
        Ok(TaskPoints {
            task,
            unseen,
            points: rolled.iter().flat_map(|episode| last(trained, episode)).collect(),
        })
    };
    all.into_iter().map(of_task).collect()
}

/// Each agent's representation after an episode's last step.
fn last(trained: &Trained, episode: &Episode) -> Vec<Vec<f32>> {
    let values = trained.model.value(&trained.params, episode, &episode.actions);
    let representations = values.map(|values| values.representations).unwrap_or_default();
    let (n, rows) = (episode.n_agents, episode.actions.len());
    let dim = representations.len() / rows.max(1);
    representations.chunks_exact(dim.max(1)).skip(rows - n).map(<[f32]>::to_vec).collect()
}

fn figure(tasks: &[TaskPoints], id: &str, whose: &str, seed: u64) -> Result<Figure, Failure> {
    let points: Vec<Vec<f32>> = tasks.iter().flat_map(|task| task.points.iter().cloned()).collect();
    let perplexity = PERPLEXITY.min(t_sne::perplexity_max(points.len()));
    let map = t_sne::map(&points, perplexity, &mut RunSeed(seed).stream(Stream::Embedding, 0));
    let mut places = map.places.into_iter();
    let shown = tasks.iter().enumerate().map(|(at, task)| Points {
        key: Key { label: format!("{}{}", task.task, if task.unseen { " (unseen)" } else { "" }), style: at },
        places: places.by_ref().take(task.points.len()).collect(),
        hollow: task.unseen,
    });
    let shown: Vec<Points> = shown.collect();
    let episodes = tasks.first().map_or(0, |first| first.points.len() / first.task.spec().n_agents.max(1));
    Ok(Figure {
        id: format!("figure-6-{id}"),
        title: format!("Figure 6 of the paper: t-SNE of task representations. {whose}"),
        caption: format!(
            "{} points of {episodes} greedy episodes a task, perplexity {perplexity:.0}, seed {seed}, exact t-SNE, 1000 \
             steps, divergence {:.2}. Rings: tasks that were never trained on.",
            points.len(),
            map.divergence
        ),
        svg: chart::map("", &shown)?,
    })
}

fn table(tasks: &[TaskPoints], id: &str, whose: &str) -> Table {
    let points: Vec<Vec<f32>> = tasks.iter().flat_map(|task| task.points.iter().cloned()).collect();
    let labels: Vec<usize> =
        tasks.iter().enumerate().flat_map(|(at, task)| vec![at; task.points.len()]).collect();
    let silhouettes = silhouette(&points, &labels);
    let of_task = |at: usize| -> Vec<f64> {
        silhouettes.iter().zip(&labels).filter(|(_, label)| **label == at).map(|(value, _)| *value).collect()
    };
    let centres: Vec<Vec<f32>> = tasks.iter().map(|task| centre(&task.points)).collect();
    let row = |(at, task): (usize, &TaskPoints)| {
        let mut others: Vec<(f64, usize)> = (0..tasks.len())
            .filter(|&other| other != at && !tasks[other].unseen)
            .map(|other| (distance(&centres[at], &centres[other]), other))
            .collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0));
        let said = |place: usize| {
            others.get(place).map_or_else(
                || "–".to_owned(),
                |(far, other)| format!("{} ({})", tasks[*other].task, signed(*far, 2)),
            )
        };
        let name = format!("{}{}", task.task, if task.unseen { " (unseen)" } else { "" });
        vec![name, signed(mean(&of_task(at)), 2), said(0), said(1)]
    };
    Table {
        id: format!("representations-{id}"),
        title: format!("Task representations: silhouettes and nearest training tasks. {whose}"),
        head: ["task", "silhouette", "nearest training task", "next"].map(str::to_owned).to_vec(),
        rows: tasks.iter().enumerate().map(row).collect(),
        note: "Silhouette: 1 where a task's representations lie far from all others', 0 where they lie between, −1 where \
               they lie among another task's. In parentheses: distance between the tasks' mean representations."
            .to_owned(), ..Table::default() }
}

fn centre(points: &[Vec<f32>]) -> Vec<f32> {
    let dim = points.first().map_or(0, Vec::len);
    let mean_of = |axis: usize| points.iter().map(|point| point[axis]).sum::<f32>() / points.len() as f32;
    (0..dim).map(mean_of).collect()
}
