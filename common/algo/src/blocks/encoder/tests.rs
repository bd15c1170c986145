use super::*;
use crate::blocks::testing::{D, Named, agent_rows, assert_close, rows};
use rit_nn::gradcheck::{check_operation, run_operation};

fn unit(heads: usize) -> (Encoder, Named) {
    Named::of(|layout| Encoder::new(layout, "utility", D, 5, 4, heads))
}

#[test]
fn within_and_beside_follow_the_specification() {
    let rows = rows();
    assert!(rows.distinct_rows().is_some(), "an entity stands still");
    for heads in [1, 2] {
        let (encoder, named) = unit(heads);
        let (mut of_within, mut of_beside) = (vec![], vec![]);
        for agent in agent_rows(&rows) {
            let entities = named.embedded("utility", &rows, agent.group);
            let own = &entities[agent.place];
            let attend = |seen: &[Vec<f64>]| named.attention("utility.attention", heads, own, seen);
            of_within.extend(attend(&agent.visible(&entities)));
            of_beside.extend(own);
            of_beside.extend(attend(&agent.visible_others(&entities)));
        }
        let within = run_operation(&named.params, &[], |tape, _| {
            encoder.within(tape, &rows, &[Visible::Where(&rows.observable)])
        });
        assert_close("within", &within, &of_within);
        assert_eq!(within[4..8], [0.0; 4], "agent 1 sees nothing: exactly zero");
        let beside = run_operation(&named.params, &[], |tape, _| encoder.beside(tape, &rows));
        assert_close("beside", &beside, &of_beside);
    }
}

/// Under several masks, an agent's row under each is what a pass with that mask alone gives.
#[test]
fn several_masks_are_several_passes() {
    let rows = rows();
    let (encoder, named) = unit(2);
    let every_second: Vec<u8> =
        rows.others.iter().enumerate().map(|(pair, &sees)| sees * u8::from(pair % 2 == 0)).collect();
    let masks = [Visible::Where(&rows.others), Visible::Where(&every_second)];
    let twice: Vec<usize> = rows.agent_distinct.iter().flat_map(|&row| [row; 2]).collect();
    let both = run_operation(&named.params, &[], |tape, _| encoder.beside_under(tape, &rows, &twice, &masks));
    let alone = masks.map(|mask| {
        run_operation(&named.params, &[], |tape, _| {
            encoder.beside_under(tape, &rows, &rows.agent_distinct, &[mask])
        })
    });
    for (row, both) in both.chunks(2 * 9).enumerate() {
        for (mask, of_mask) in both.chunks(9).enumerate() {
            let alone: Vec<f64> = alone[mask][row * 9..][..9].iter().map(|&x| x.into()).collect();
            assert_close("a row under a mask", of_mask, &alone);
        }
    }
}

/// Derived layers count as parameters here: what they are made of has a test of its own.
#[test]
fn gradients_are_the_numeric_ones() {
    let rows = rows();
    let masks = [Visible::Where(&rows.observable), Visible::All];
    let twice: Vec<usize> = rows.agent_distinct.iter().flat_map(|&row| [row; 2]).collect();
    for heads in [1, 2] {
        let (encoder, named) = unit(heads);
        let numbers = named.params.len();
        check_operation(numbers, &[], |tape, _| encoder.within(tape, &rows, &masks));
        check_operation(numbers, &[], |tape, _| encoder.beside(tape, &rows));
        check_operation(numbers, &[], |tape, _| encoder.beside_under(tape, &rows, &twice, &masks));
    }
}
