use super::*;
use crate::blocks::testing::{D, Named, agent_rows, assert_close, relu, rows};
use rit_nn::gradcheck::{check_operation, run_operation};

fn unit(heads: usize) -> (TaskEncoder, Named) {
    Named::of(|layout| {
        let encoder = Encoder::new(layout, "task_encoder", D, 5, 4, heads);
        TaskEncoder::new(layout, encoder, 2, 3)
    })
}

/// Each agent by itself, one time after another.
#[test]
fn representations_follow_the_specification() {
    let rows = rows();
    for heads in [1, 2] {
        let (task_encoder, named) = unit(heads);
        let (mut histories, mut representations): (Vec<Vec<f64>>, Vec<f64>) = (vec![], vec![]);
        let mut agents = agent_rows(&rows).into_iter();
        for (group, step) in rows.steps.iter().enumerate() {
            for (place, agent) in agents.by_ref().take(rows.groups[group].queries.len()).enumerate() {
                let entities = named.embedded("task_encoder", &rows, agent.group);
                let own = &entities[place];
                let seen = agent.visible_others(&entities);
                let attended = named.attention("task_encoder.attention", heads, own, &seen);
                let reward = f64::from(rows.previous_rewards[group]);
                assert_eq!(reward == 0.0, step.time == 0);
                let reward = relu(named.linear("task_encoder.reward_embed", &[reward]));
                let before = match step.time {
                    0 => vec![0.0; 5],
                    time => {
                        let before = rows.group_of(step.episode, time - 1);
                        histories[rows.groups[before].queries.start + place].clone()
                    }
                };
                let x = [&own[..], &attended, &reward].concat();
                let history = named.gru("task_encoder.gru", &x, &before);
                representations.extend(named.linear("task_encoder.out", &history));
                histories.push(history);
            }
        }
        let run = |which: fn((Var, Var)) -> Var| {
            run_operation(&named.params, &[], |tape, _| which(task_encoder.forward(tape, &rows, None)))
        };
        assert_close("history", &run(|(history, _)| history), &histories.concat());
        assert_close("representation", &run(|(_, representation)| representation), &representations);
    }
}

/// Derived layers count as parameters here: what they are made of has a test of its own.
#[test]
fn gradients_are_the_numeric_ones() {
    let rows = rows();
    let (task_encoder, named) = unit(2);
    check_operation(named.params.len(), &[], |tape, _| task_encoder.forward(tape, &rows, None).1);
}
