// The page of a cloth.
import { start } from "viewer/main";
import { ClothScene } from "viewer/cloth";

start(ClothScene);
