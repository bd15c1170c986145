//! `rit render`: what it writes is decoded again.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "helpers of tests are tests too")]

mod common;

use common::{RunFolder, output, refused};
use gif::{ColorOutput, DecodeOptions, Repeat};
use serde_json::Value;
use std::{
    fs::{self, File},
    io::BufReader,
    path::{Path, PathBuf},
};

/// Steps of every episode of the particle worlds.
const STEPS: usize = 25;
/// The chase script on the smallest task with two prey.
const CHASE: [&str; 6] =
    ["--policy", "script:chase", "--experiment", "predator-prey", "--task", "predator-prey-3-2"];

/// Draws into this file of the folder; returns its path and what was said.
fn render(folder: &Path, name: &str, arguments: &[&str]) -> (PathBuf, String) {
    let path = folder.join(name);
    let output = output(&[&["render", "--out", path.to_str().unwrap()], arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    (path, String::from_utf8(output.stdout).unwrap())
}

/// Mean return that `rit evaluate` measures.
fn mean_return(task: &str, arguments: &[&str]) -> f64 {
    let output = output(&[&["evaluate", "--json", "--tasks", task], arguments].concat());
    let output: Value = serde_json::from_slice(&output.stdout).unwrap();
    output["tasks"][task]["mean_return"].as_f64().unwrap()
}

/// The delay of each frame of a GIF, in hundredths of a second, after a look at its pixels.
fn delays(path: &Path) -> Vec<u16> {
    let mut options = DecodeOptions::new();
    options.set_color_output(ColorOutput::Indexed);
    let mut decoder = options.read_info(BufReader::new(File::open(path).unwrap())).unwrap();
    let (width, height) = (decoder.width(), decoder.height());
    assert_eq!((width, height), (520, 626));
    let mut delays = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        assert!(frame.left + frame.width <= width && frame.top + frame.height <= height);
        let drawn = frame.buffer.iter().filter(|&&index| Some(index) != frame.transparent).count();
        assert!(drawn > 100, "frame {} shows nothing new", delays.len());
        delays.push(frame.delay);
    }
    assert_eq!(decoder.repeat(), Repeat::Infinite);
    delays
}

#[test]
fn a_gif_shows_every_step_of_every_episode() {
    let folder = RunFolder::new();
    let (path, said) = render(folder.path(), "a.gif", &[&CHASE[..], &["--episodes", "2"]].concat());
    let delays = delays(&path);
    assert_eq!(delays.len(), 2 * (STEPS + 1));
    let episode = [&[60][..], &[12; STEPS - 1], &[200]].concat();
    assert_eq!(delays, [&episode[..], &episode].concat());
    assert!(said.contains("predator-prey-3-2 by script:chase") && said.lines().count() == 1, "{said}");
}

#[test]
fn a_png_has_six_moments_of_each_episode() {
    let folder = RunFolder::new();
    let (path, _) = render(folder.path(), "a.png", &[&CHASE[..], &["--episodes", "2"]].concat());
    let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!((info.width, info.height), (2016, 846));
    // In the row of plots of each episode there are obstacles, in every moment of it.
    let width = info.width as usize;
    let is_grey = |x: usize, y: usize| {
        let pixel = &pixels[3 * (y * width + x)..][..3];
        pixel.iter().all(|&value| (105..115).contains(&value))
    };
    for top in [74, 74 + 384] {
        for left in (0..6).map(|moment| 18 + moment * 332) {
            let grey = (left + 2..left + 318)
                .flat_map(|x| (top + 2..top + 318).map(move |y| (x, y)))
                .filter(|&(x, y)| is_grey(x, y))
                .count();
            assert!(grey > 100, "{grey} pixels of obstacles at {left}, {top}");
        }
    }
}

#[test]
fn an_svg_is_well_formed_and_everything_lies_within() {
    let folder = RunFolder::new();
    // Standing still catches nothing: there is no reward to scale the bars by.
    let still = ["--policy", "script:still", "--experiment", "predator-prey", "--task", "predator-prey-3-2"];
    for (arguments, episodes, size) in [(CHASE, "5", [1922.0, 1126.0]), (still, "1", [494.0, 602.0])] {
        let (path, said) =
            render(folder.path(), "a.svg", &[&arguments[..], &["--force", "--episodes", episodes]].concat());
        let text = fs::read_to_string(path).unwrap();
        let document = roxmltree::Document::parse(&text).unwrap();
        let number = |node: roxmltree::Node<'_, '_>, name: &str| -> f32 {
            node.attribute(name).unwrap().parse().unwrap()
        };
        let root = document.root_element();
        assert_eq!(["width", "height"].map(|name| number(root, name)), size);
        let drawn = root.children().filter(|node| node.has_tag_name(("http://www.w3.org/2000/svg", "g")));
        assert_eq!(drawn.count().to_string(), episodes);
        for node in document.descendants().filter(|node| node.tag_name().name() == "circle") {
            let [x, y, radius] = ["cx", "cy", "r"].map(|name| number(node, name));
            assert!(x - radius >= 0.0 && x + radius <= size[0], "{node:?}");
            assert!(y - radius >= 0.0 && y + radius <= size[1], "{node:?}");
        }
        assert!(!text.contains("NaN") && !text.contains("inf"), "{arguments:?}");
        // The returns that were said are those that are drawn.
        for total in said.trim().split_once("return ").unwrap().1.split(", ") {
            assert!(text.contains(&format!("return {total} in 25 steps")), "{total}");
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let folder = RunFolder::new();
    for ending in ["gif", "png", "svg"] {
        let draw = |name: &str, seed: &str| {
            let (path, _) =
                render(folder.path(), &format!("{name}.{ending}"), &[&CHASE[..], &["--seed", seed]].concat());
            fs::read(path).unwrap()
        };
        let first = draw("a", "1");
        assert!(first == draw("b", "1"), "{ending}");
        assert!(first != draw("c", "2"), "{ending}");
    }
}

#[test]
fn a_checkpoint_plays_the_episodes_that_are_evaluated() {
    let folder = RunFolder::new();
    folder.train(&["cooperative-navigation", "--steps", "100", "--set", "evaluation.episodes=1"]);
    let run_dir = folder.run_dir();
    let run = ["--run", run_dir.to_str().unwrap(), "--seed", "3"];
    let (path, said) = render(folder.path(), "a.gif", &[&run[..], &["--task", "navigation-5-5"]].concat());
    assert_eq!(delays(&path).len(), STEPS + 1);
    let measured = mean_return("navigation-5-5", &[&run[..], &["--episodes", "1"]].concat());
    assert!(said.ends_with(&format!("return {measured:.2}\n")), "{measured}: {said}");
}

#[test]
fn what_cannot_be_drawn_is_refused_and_leaves_nothing() {
    let folder = RunFolder::new();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let render = |name: &str, arguments: &[&str], message: &[&str]| {
        refused(&[&["render", "--out", &path(name)], arguments].concat(), message);
    };
    render("a.jpeg", &CHASE, &["a.jpeg", ".gif, .png or .svg"]);
    render("nowhere/a.gif", &CHASE, &["nowhere/a.gif", "there is no folder"]);
    let task = ["--policy", "script:chase", "--experiment", "predator-prey", "--task", "predator-prey-0-3"];
    render("a.gif", &task, &["predator-prey-0-3", "predators must be 1 to 64"]);
    let game = ["--policy", "script:random", "--experiment", "matrix-game", "--task", "game-1"];
    render("a.gif", &game, &["game-1", "there is nothing to draw"]);
    render("a.gif", &["--task", "game-1"], &["give --run DIR", "--policy script:NAME"]);
    render("a.gif", &["--run", &path("run"), "--task", "game-1"], &["run"]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn a_file_is_written_over_only_when_asked() {
    let folder = RunFolder::new();
    let path = folder.path().join("a.svg");
    fs::write(&path, "precious").unwrap();
    let arguments = [&["render", "--out", path.to_str().unwrap()], &CHASE[..]].concat();
    refused(&arguments, &["a.svg is there already", "--force"]);
    assert_eq!(fs::read_to_string(&path).unwrap(), "precious");
    render(folder.path(), "a.svg", &[&CHASE[..], &["--force"]].concat());
    assert!(fs::read_to_string(&path).unwrap().starts_with("<svg"));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "nothing else is left");
}
